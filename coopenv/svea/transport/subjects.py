"""Names of topics on NATS."""


def subject_of(topic: str) -> str:
    """Return a topic's name on the wire."""
    return topic.replace("/", ".")


def topic_of(subject: str) -> str:
    """Return the topic of a name on the wire."""
    return subject.replace(".", "/")


def subjects_of(pattern: str) -> tuple[str, ...]:
    """Return subjects that hold at least what a pattern matches; NATS has no `**` but at the end, for one or more."""
    parts = pattern.split("/")
    if "**" not in parts:
        return (subject_of(pattern),)
    first = parts.index("**")
    before = ".".join(parts[:first])
    if not before:
        return (">",)
    alone = all(part == "**" for part in parts[first:])
    return (before, f"{before}.>") if alone else (f"{before}.>",)

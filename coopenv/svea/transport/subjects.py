"""Topics and what is beside a message, as NATS has them."""

import base64
import binascii

ATTACHMENT = "Coopenv-Attachment"
"""Header, base64; the authors' connector looks at no headers."""


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


def headers_of(attachment: bytes) -> dict[str, str] | None:
    """Return the headers of a message (None: it needs none)."""
    return {ATTACHMENT: base64.b64encode(attachment).decode()} if attachment else None


def attachment_of(headers: dict[str, str] | None) -> bytes:
    """Return what is beside a message; nothing, if its header is none of ours."""
    try:
        return base64.b64decode((headers or {}).get(ATTACHMENT, ""), validate=True)
    except (binascii.Error, ValueError):
        return b""

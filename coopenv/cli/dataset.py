"""`coopenv dataset`: episodes for offline reinforcement learning."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import complete, options


def dataset(
    environment: options.Environment,
    policy: Annotated[
        str,
        typer.Option(
            "--policy",
            help="Who drives: random, the name of an agent, its folder, or mine.py:Mine.",
            **complete.POLICY,
        ),
    ] = "route_follower",
    worlds: Annotated[
        int, typer.Option(min=1, max=options.MOST_WORLDS, help="Worlds; an episode of each of their vehicles is kept.")
    ] = 64,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the worlds.")] = 0,
    overrides: options.Overrides = None,
    identity: Annotated[
        str | None, typer.Option("--id", help="NAMESPACE/NAME-v0 of the dataset (default: coopenv/ENV/POLICY-v0).")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of datasets (default: MINARI_DATASETS_PATH or ~/.minari/datasets).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a dataset that is there.")] = False,
) -> None:
    """Write episodes of a policy as a Minari dataset, one per vehicle."""
    import shlex

    name, log = Path(environment).stem, options.console(stderr=True)
    scenario = options.load(environment, options.parse_overrides(overrides))
    from coopenv.base.installation import list_envs
    from coopenv.policies import load_policy
    from coopenv.runs.console import Progress, compile_notice
    from coopenv.runs.driven import drive_vehicles
    from coopenv.runs.minari import dataset_place, write_dataset

    driver = load_policy(policy, scenario, seed)
    own = Path(policy.rpartition(":")[2] or policy).name
    identity = identity or f"coopenv/{name}/{own}-v0"
    place = dataset_place(identity, out, force)
    with Progress(log, "driving", total=1.0) as progress, compile_notice(log):
        episodes = drive_vehicles(scenario, driver, seed, worlds, progress.update)
    words = ["coopenv", "dataset", environment, "--policy", policy, "--worlds", str(worlds), "--seed", str(seed)]
    words += [word for assignment in overrides or () for word in ("--set", assignment)]
    facts = {"algorithm_name": own, "description": f"{scenario.title}: {shlex.join(words)}"}
    registered = name if environment in list_envs() and not overrides else ""
    write_dataset(episodes, scenario, registered, place, identity, facts)
    steps = sum(len(episode.actions) for episode in episodes)
    told = f"{len(episodes)} episodes, {steps:,} steps"
    options.console().print(f"{place.parent}: {told}, minari.load_dataset('{identity}')", soft_wrap=True)

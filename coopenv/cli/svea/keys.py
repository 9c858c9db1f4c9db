"""`coopenv svea keys`: keys with which cars and stations sign."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError


def keys(
    deployment: Annotated[
        Path | None,
        typer.Argument(metavar="[DEPLOYMENT.toml]", help="Deployment: keys for its cars and its station."),
    ] = None,
    names: Annotated[str | None, typer.Option(help="Names instead, with commas between: svea7,svea8,station.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the keys (default: the deployment's security.keys, or keys).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Make new keys even of those who have some.")] = False,
) -> None:
    """Make keys: NAME.pem of each car and of the station, which nobody else may have, and public.toml for all.

    Give each car its own NAME.pem and public.toml, by a channel that you trust, and delete it here. Who has keys
    already keeps them.
    """
    from coopenv.cars.keys import PUBLIC, make_keys

    if (deployment is None) == (names is None):
        raise CoopenvError("keys: name a deployment file, or identities with --names, and not both")
    folder, wanted = out or Path("keys"), [name.strip() for name in (names or "").split(",")]
    if deployment is not None:
        from coopenv.cars.deployment import load_deployment

        read = load_deployment(deployment)
        wanted = [*(car.name for car in read.cars), read.security.identity]
        folder = out or read.folder / (read.security.keys or "keys")
    new, kept = make_keys(folder, wanted, force)
    for name in new:
        print(f"{folder / f'{name}.pem'}: new, for {name} alone")
    for name in kept:
        print(f"{name}: has a key already, which is kept")
    print(f"{folder / PUBLIC}: for everybody")

"""`python -m benchmarks.freeze v1`: record the actions of the drivers of a frozen benchmark, before its first run.

The definition is written first. Then `coopenv bench v1` with the main observers of the zoo makes
the file of the shipped rows.
"""

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from rich.progress import track

from coopenv.base.errors import CoopenvError
from coopenv.bench.frozen import FOLDER, Frozen, FrozenScene
from coopenv.policies import load_policy
from coopenv.policies.base import decide, restart
from coopenv.runs.recorder import record


class Rounded:
    """The policy of a scene, with its actions (rows, A) rounded to float16 and kept, one entry per decision."""

    def __init__(self, scene: FrozenScene, seed: int) -> None:
        self.scenario = scene.source.fault(scene.variant).scenario or scene.source.scenario
        self._policy = load_policy(scene.source.policy, self.scenario, seed)
        self.taken: list[np.ndarray] = []

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """See `Policy`."""
        self.taken.append(decide(self._policy, observations, self.scenario.action_size).astype(np.float16))
        return self.taken[-1].astype(np.float64)

    def reset(self, mask: np.ndarray) -> None:
        """See `Policy`."""
        restart(self._policy, mask)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the file of the actions; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.freeze", description=__doc__)
    parser.add_argument("version", choices=[path.stem for path in FOLDER.glob("v*.toml")])
    version = parser.parse_args(arguments).version
    path = FOLDER / f"{version}_actions.npz"
    if path.exists():
        print(f"error: {path} exists: a version never changes; remove it to record another one", file=sys.stderr)
        return 2
    frozen, actions = Frozen(version), {}
    try:
        for scene in track([s for s in frozen.scenes() if s.source.policy != "zero"], "scenes"):
            rounded = [Rounded(scene, seed) for seed in frozen.seeds]
            for policy, seed in zip(rounded, frozen.seeds, strict=True):
                record(policy.scenario, seed, policy)
            actions[scene.name] = np.array([policy.taken for policy in rounded])
        np.savez_compressed(path, allow_pickle=False, **actions)
    except (CoopenvError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{path}: {', '.join(f'{name} {a.shape}' for name, a in actions.items())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

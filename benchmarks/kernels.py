"""`python -m benchmarks.kernels`: compile the kernels that a wheel brings, in `coopenv/data/kernels`.

Every shipped environment takes a step, in both precisions, with its own observer and with others that have kernels. The
code is for this operating system and for processors of level x86-64-v3; elsewhere kernels are compiled at their first
use. Warp finds a module by the hash of its source, so that modules of another version are never used.
"""

import os
import shutil
import sys
import tempfile
import warnings
from itertools import product
from pathlib import Path

PRECISIONS, OBSERVERS = ("float32", "float64"), (None, "riccati", "robust", "dead_reckoning")


def main() -> int:
    """Write the modules and print their number and size."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["WARP_CACHE_PATH"] = cache  # before Warp is imported
        import coopenv
        from coopenv.base.errors import CoopenvError
        from coopenv.world.launch import cache_folder, modules

        warnings.simplefilter("ignore")
        for name, dtype, observer in product(coopenv.list_envs(), PRECISIONS, OBSERVERS):
            try:
                env = coopenv.parallel_env(name, observer=observer, dtype=dtype)
            except CoopenvError as error:  # a co-simulator that is not installed
                print(f"{name}: {error}", file=sys.stderr)
                continue
            env.reset(seed=0)
            env.step({agent: env.action_space(agent).sample() for agent in env.agents})
            env.close()
            print(f"{name}, {dtype}, {observer or 'its observer'}: {len(modules())} modules", flush=True)
        target = Path(coopenv.__file__).parent / "data" / "kernels"
        shutil.rmtree(target, ignore_errors=True)
        for module in sorted(modules()):
            shutil.copytree(cache_folder() / module, target / module, ignore=shutil.ignore_patterns("*.cpp"))
    files = [path for path in target.rglob("*") if path.is_file()]
    megabytes = sum(path.stat().st_size for path in files) / 1e6
    print(f"{target}: {len({path.parent for path in files})} modules, {megabytes:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())

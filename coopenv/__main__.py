"""The command `coopenv`, also `python -m coopenv`: signals are caught before anything else is loaded."""

import codecs
import gc
import io
import os
import sys
from pathlib import Path

from coopenv.base import interrupts


def main() -> int:
    """Run the command line of this process and return its exit status."""
    gc.set_threshold(100_000)  # imports and scenarios make many objects that stay
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small, and threads take a fifth of `coopenv list`
    interrupts.install()
    from coopenv.base.errors import escaped

    codecs.register_error("escaped", escaped)
    sys.stderr = sys.stderr or Path(os.devnull).open("w")  # noqa: SIM115 (libraries write to a closed one too)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="escaped")  # file names need not be text
    try:
        from coopenv.cli.app import main

        status = main()
    except BaseException:
        if not interrupts.received():
            raise
        status = interrupts.report()
    if interrupts.received():
        interrupts.end(status)
    gc.freeze()  # the process ends: to look for unused objects once more takes most of a second
    return status


if __name__ == "__main__":
    sys.exit(main())

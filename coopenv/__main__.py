"""The command `coopenv`, also `python -m coopenv`: signals are caught before anything else is loaded."""

import io
import sys

from coopenv import interrupts


def main() -> int:
    """Run the command line of this process and return its exit status."""
    interrupts.install()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # file names need not be text
    try:
        from coopenv.cli import main

        status = main()
    except BaseException:
        if not interrupts.received():
            raise
        status = interrupts.tell()
    if interrupts.received():
        interrupts.end(status)
    return status


if __name__ == "__main__":
    sys.exit(main())

"""`python -m coopenv.cli`."""

import sys

from coopenv.cli import main

sys.exit(main())

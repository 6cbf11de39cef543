"""`python -m benchmarks.classics`."""

import sys

from benchmarks.classics.tuning import main

sys.exit(main())

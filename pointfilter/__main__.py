"""`python -m pointfilter`: the command, for where its script is not on the PATH."""

import sys

from pointfilter.cli import main

sys.exit(main())

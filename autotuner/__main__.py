"""`python -m autotuner`."""

import sys

from autotuner.cli import main

sys.exit(main())

"""`python -m phase_sumo`, which `torchrun` starts."""

import sys

from phase_sumo.cli import main

sys.exit(main())

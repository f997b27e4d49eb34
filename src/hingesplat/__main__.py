"""``python -m hingesplat``."""

import sys

from hingesplat.cli import main

sys.exit(main())

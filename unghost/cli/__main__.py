"""``python -m unghost.cli``."""

import sys

from .entry import main

sys.exit(main())

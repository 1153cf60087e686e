"""`python -m pacesetter` is the command."""

import sys

from pacesetter.cli import main

sys.exit(main())

"""`python -m pacesetter` is the command."""

import sys

from pacesetter.cli.main import main

sys.exit(main())

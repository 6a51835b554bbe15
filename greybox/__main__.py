"""`python -m greybox` is the command `greybox`."""

from greybox.cli import main

raise SystemExit(main())

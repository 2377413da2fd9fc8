"""`python -m vla_eval.cli` is `mikasa-vla`."""

import sys

from vla_eval.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

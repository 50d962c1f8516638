"""`python -m amers` is the command `amers`: it imports nothing from the working folder either."""

import os
import sys

if sys.path and sys.path[0] == os.getcwd():
    del sys.path[0]

from amers.app.cli.main import main

if __name__ == "__main__":
    main()

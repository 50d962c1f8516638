"""`python -m amers` is the command `amers`."""

from amers.app.cli.main import main

if __name__ == "__main__":
    main()

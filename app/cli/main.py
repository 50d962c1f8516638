"""The command `amers`: noun, then verb; a group of commands is one file, registered here by one line.

Exit codes: 0 done, 2 the input cannot be used, 3 the scene could not be registered, 1 anything else.
"""

import signal
import sys
from types import FrameType

import typer

from app.cli import audit, block, db, demo, points, production, reference, scene, serve, token, worker
from app.errors import AmersError, ComputationError

EXIT_REFUSED = 2
EXIT_NOT_REGISTERED = 3
EXIT_INTERRUPTED = 130

app = typer.Typer(
    name="amers",
    help="An open base of 3D ground control points, and the registration of satellite scenes on them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(block.app, name="block")
app.add_typer(points.app, name="points")
app.add_typer(scene.app, name="scene")
app.add_typer(reference.app, name="reference")
app.add_typer(production.app, name="production")
app.add_typer(db.app, name="db")
app.add_typer(token.app, name="token")
app.command("demo")(demo.demo)
app.command("serve")(serve.serve)
app.command("worker")(worker.worker)
app.command("audit")(audit.audit)


def main() -> None:
    """Run one command; an error that the user can understand is one line, not a trace."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _leave)
    try:
        app()
    except AmersError as error:
        typer.echo(f"amers: {error}", err=True)
        sys.exit(EXIT_NOT_REGISTERED if isinstance(error, ComputationError) else EXIT_REFUSED)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)


def _leave(number: int, frame: FrameType | None) -> None:
    """Ends by an exception, so that what was opened is closed: the private database, a worker."""
    raise SystemExit(128 + number)


if __name__ == "__main__":
    main()

"""The program ``fluoromap``: its table of commands and its entry point.

The command ``X`` is the Typer application ``app`` of the module ``X`` beside this one; a hyphen becomes an underscore.
Exit codes: 0 done, 1 failed with a sentence that says what to do, 2 wrong usage.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

import typer.main
from typer.core import TyperCommand, TyperGroup

from fluoromap_service.cli.environment import limit_threads, use_safe_paths
from fluoromap_service.cli.failures import sentence_of

COMMANDS = {
    "demo": "Simulate a study, run it through the real service and compare the results with the truth.",
    "up": "Run the API and a worker.",
    "run": "Run the pipeline over a folder, on a private service.",
    "simulate": "Simulate a study: DICOM runs, activation times and the truth.",
    "recording": "Show the channels of an EP recorder's export, and check all its samples.",
    "tables": "Print the paper's tables beside our own, computed on simulated data.",
    "figures": "Make the paper's Figures 3, 4 and 5 on a simulated study.",
    "api": "Run the API alone.",
    "worker": "Run a worker, which computes the stages of jobs.",
    "dicom-listener": "Receive X-ray runs by DICOM C-STORE.",
    "sender": "Send the results of jobs to the configured targets.",
    "deliveries": "Show and repeat the deliveries of results to targets.",
    "db": "Manage the database.",
    "token": "Manage access tokens.",
    "sign-in": "Print a link that signs a browser in.",
    "backup": "Write database and files into one archive, while the service runs.",
    "restore": "Bring a backup into an empty data folder.",
    "export": "Write the runs and results of a job without the patient's identity.",
    "check": "Check every stored file, and mend the store.",
    "audit": "Read the audit trail: who did what to which study.",
    "plugins": "List the installed plugins, and why a broken plugin does not load.",
}
"""Name of each command, and the first sentence of its help."""


class CommandGroup(TyperGroup):
    """Group that imports the module of a command only when a user calls that command.

    Some commands import NumPy, numba, FastAPI and Celery, which takes seconds; ``fluoromap --help`` needs none of them.
    """

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return the name, the imported command and the remaining arguments."""
        name, entry, rest = super().resolve_command(ctx, args)
        return name, entry if name is None else load(name), rest


def load(name: str) -> Any:
    """Import the module of a command and return the command."""
    module = import_module(f"fluoromap_service.cli.commands.{name.replace('-', '_')}")
    return typer.main.get_command(module.app)


program = CommandGroup(
    name="fluoromap",
    help="Activation maps of a heart chamber from ordinary C-arm fluoroscopy.",
    commands={name: TyperCommand(name, help=sentence) for name, sentence in COMMANDS.items()},
    no_args_is_help=True,
)


def main() -> None:
    """Run the program with the arguments of the process."""
    use_safe_paths()
    # Before any command imports NumPy or numba.
    limit_threads()
    try:
        program()
    except Exception as error:
        sentence = sentence_of(error)
        if sentence is None:
            raise
        print(f"fluoromap: {sentence}", file=sys.stderr)
        sys.exit(1)

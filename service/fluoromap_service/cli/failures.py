"""Failures that a user can do something about. Each ends the program with exit code 1 and one sentence."""

from __future__ import annotations

from pydantic import ValidationError

from fluoromap_service.problem import Problem
from fluoromap_service.settings import Settings
from fluoromap_service.store.disk import FULL


class CommandFailed(Exception):
    """A command that cannot go on; the message says what is wrong and what to do."""


def sentence_of(error: Exception) -> str | None:
    """Return the sentence that the user reads.

    Returns
    -------
    str or None
        None when the error is a bug of the program.
    """
    if isinstance(error, CommandFailed):
        return str(error)
    if isinstance(error, Problem):
        places = "; ".join(f"{where}: {message}" for where, message in error.errors)
        return f"{error.detail} ({places})" if places else error.detail
    if isinstance(error, ValidationError) and error.title == Settings.__name__:
        settings = "; ".join(f"FLUOROMAP_{part['loc'][0]}".upper() + f": {part['msg']}" for part in error.errors())
        return f"A setting is wrong ({settings}); correct the environment variable."
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}."
    if isinstance(error, OSError) and error.errno in FULL:
        return "The disk is full; free space on it, then call the command again."
    return None

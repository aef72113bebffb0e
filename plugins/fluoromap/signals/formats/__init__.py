"""The formats of EP recorders: each module recognises its files by what they contain, and reads their header."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fluoromap.signals.formats import cardiolab, carto, ep_tracer, labsystem, workmate
from fluoromap.signals.recording import NotARecording, Recording, Sources

_HEAD_BYTES = 2**14


@dataclass(frozen=True, slots=True)
class Format:
    """One recorder's format.

    recognises : whether a file is of it, by name and first bytes. read : all files of an export -> recording. several : whether an
    export has more than one file.
    """

    name: str
    recognises: Callable[[str, bytes], bool]
    read: Callable[[Sources], Recording]
    several: bool = False


FORMATS = (
    Format(labsystem.FORMAT, labsystem.recognises, labsystem.read),
    Format(carto.FORMAT, carto.recognises, carto.read),
    Format(ep_tracer.FORMAT, ep_tracer.recognises, ep_tracer.read),
    Format(cardiolab.FORMAT, cardiolab.recognises, cardiolab.read, several=True),
    Format(workmate.FORMAT, workmate.recognises, workmate.read, several=True),
)


def read_recording(sources: Sources) -> Recording:
    """Recognise an export by its content, and read its header.

    Its samples are read later.

    Parameters
    ----------
    sources : mapping of str to Path
        All files of the export by the names that the recorder gave them.

    Raises
    ------
    NotARecording
        When no format fits, or the export is damaged.
    """
    if not sources:
        raise NotARecording("No file came; send the files of one export.")
    heads = {}
    for name, path in sources.items():
        with path.open("rb") as stream:
            heads[name] = stream.read(_HEAD_BYTES)
    for each in FORMATS:
        if not any(each.recognises(name, head) for name, head in heads.items()):
            continue
        if len(sources) > 1 and not each.several:
            raise NotARecording(
                f"{len(sources)} files came, and an export of {each.name} is one; send them one by one."
            )
        return each.read(sources)
    known = ", ".join(each.name for each in FORMATS)
    raise NotARecording(f"The files are of no known recorder. Known are exports of {known}.")

"""Reading object dictionaries: EDS and DCF files, through the canopen package."""

import logging
from collections.abc import Iterable
from pathlib import Path

import canopen
from canopen.objectdictionary import ObjectDictionary

from canwall.errors import InputError


class DictionaryError(InputError):
    """An EDS or DCF that cannot be used."""


def load_eds(path: Path, node_id: int, required: Iterable[int] = ()) -> ObjectDictionary:
    """The object dictionary that a file describes, for a node.

    Raises DictionaryError for a file that is missing or not an EDS, or that lacks one of the
    `required` objects (indices).
    """
    if not path.is_file():
        raise DictionaryError(f"{path}: no such EDS or DCF; correct drive.eds")
    # canopen logs a traceback for an odd entry and goes on; what matters is missed below.
    logging.getLogger("canopen.objectdictionary").setLevel(logging.CRITICAL)
    try:
        # canopen opens paths in the encoding of the locale; vendors write any.
        with path.open(encoding="utf-8", errors="replace") as file:
            dictionary = canopen.import_od(file, node_id)
    except Exception as error:  # the parser lets configparser, ValueError, KeyError … through
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DictionaryError(f"{path}: not a readable EDS or DCF: {text}") from None
    missing = [index for index in required if index not in dictionary]
    if missing:
        listed = ", ".join(f"0x{index:04X}" for index in missing)
        raise DictionaryError(f"{path}: lacks object {listed}; this drive cannot render a wall")
    return dictionary

"""Reading of object dictionaries: EDS and DCF files (CiA 306), with the canopen package.

The parser of the package fails on much that CiA 306 allows and vendors write. A file is therefore
read here, normalised to the form that the parser understands, and then passed to it.
"""

import io
import logging
import re
from collections.abc import Iterable, Mapping
from configparser import RawConfigParser
from pathlib import Path
from typing import TypeAlias

import canopen
from canopen.objectdictionary import ObjectDictionary, datatypes

from canwall.errors import InputError


class DictionaryError(InputError):
    """An EDS or DCF that cannot be used."""


_Section: TypeAlias = dict[str, str]
_Sections: TypeAlias = dict[str, _Section]

_KEYS = {
    key.lower(): key
    for key in (
        "ParameterName",
        "ObjectType",
        "DataType",
        "AccessType",
        "DefaultValue",
        "ParameterValue",
        "LowLimit",
        "HighLimit",
        "PDOMapping",
        "SubNumber",
        "CompactSubObj",
        "NrOfEntries",
        *(f"Dummy{data_type:04d}" for data_type in range(1, 8)),
    )
}
_NUMBERS = ("DefaultValue", "ParameterValue", "LowLimit", "HighLimit")
_NO_NUMBERS = datatypes.DATA_TYPES
_OBJECT = re.compile(r"([0-9A-F]{4})(?:(SUB)([0-9A-F]+)|(NAME|VALUE))?", re.IGNORECASE)
_NODE_ID = re.compile(r"\$?NODEID", re.IGNORECASE)
_OCTAL = re.compile(r"0[0-7]+")
#: Sections without objects; they have entries that the parser would insist on.
_NO_OBJECTS = ("fileinfo", "deviceinfo", "devicecomissioning", "comments")

_DOMAIN_OBJECT = 0x2
#: Defaults of CiA 306 for a DOMAIN.
_DOMAIN = {"ObjectType": f"0x{_DOMAIN_OBJECT:X}", "DataType": "0x000F", "AccessType": "rw"}


def load_eds(path: Path, node_id: int, required: Iterable[int] = ()) -> ObjectDictionary:
    """Load the object dictionary of an EDS or DCF.

    Args:
        path: The file.
        node_id: Node-ID that replaces $NODEID in values.
        required: Indices of objects that the dictionary has to have.

    Raises:
        DictionaryError: If the file is missing, not an EDS or DCF, or lacks a required object.
    """
    if not path.is_file():
        raise DictionaryError(
            f"{path}: no such EDS or DCF; correct drive.eds, or give --eds to a command that has it"
        )
    # canopen logs a traceback for an odd entry and continues; required objects are checked below.
    logging.getLogger("canopen.objectdictionary").setLevel(logging.CRITICAL)
    try:
        file = io.StringIO(_as_text(_normalise(_read_sections(path), node_id)))
        file.name = path.name
        dictionary = canopen.import_od(file, node_id)
    except Exception as error:  # configparser errors, ValueError, KeyError and others
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DictionaryError(f"{path}: not a readable EDS or DCF: {text}") from None
    missing = [index for index in required if index not in dictionary]
    if missing:
        listed = ", ".join(f"0x{index:04X}" for index in missing)
        raise DictionaryError(f"{path}: lacks object {listed}; this drive cannot render a wall")
    return dictionary


def _read_sections(path: Path) -> _Sections:
    """Read the sections, with names and keys in the spelling of CiA 306."""
    raw = path.read_bytes()
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    # The last one of repeated keys counts; an indented line does not continue the one before.
    parser = RawConfigParser(strict=False, delimiters=("=",), inline_comment_prefixes=(";",))
    parser.read_file(line.strip() for line in io.StringIO(text, newline=None))
    sections: _Sections = {}
    for name in parser.sections():
        section = sections.setdefault(_section_name(name), {})
        section.update({_KEYS.get(key, key): value for key, value in parser[name].items()})
    return sections


def _section_name(name: str) -> str:
    match = _OBJECT.fullmatch(name)
    if match is None:
        return name
    index, sub, subindex, rest = match.groups()
    return index.upper() + (f"sub{int(subindex, 16):X}" if sub else (rest or "").capitalize())


def _normalise(sections: _Sections, node_id: int) -> _Sections:
    """Return the same dictionary without what the parser cannot read."""
    normal: _Sections = {"DeviceInfo": {}}  # the parser requires this section
    for name, section in sections.items():
        match = _OBJECT.fullmatch(name)
        if match is None:
            if name.lower() == "dummyusage":
                normal["DummyUsage"] = {f"Dummy{n:04d}": "0" for n in range(1, 8)} | section
            elif name.lower() not in _NO_OBJECTS:
                normal[name] = section
        elif not match.group(4):
            normal |= _expand(name, section, sections)
    return {name: _resolve_numbers(section, node_id) for name, section in sorted(normal.items())}


def _expand(name: str, section: _Section, sections: Mapping[str, _Section]) -> _Sections:
    """Expand CompactSubObj to a section per sub-index."""
    head = {key: value for key, value in section.items() if value or key == "ParameterName"}
    entries = int(head.pop("CompactSubObj", "") or "0", 0)
    if not entries:
        is_domain = int(head.get("ObjectType") or "0x7", 0) == _DOMAIN_OBJECT
        return {name: _DOMAIN | head if is_domain else head}
    names, values = (sections.get(f"{name}{what}", {}) for what in ("Name", "Value"))
    template = head | {"ObjectType": "0x7"}
    expanded = {
        name: {"ParameterName": head["ParameterName"], "ObjectType": head["ObjectType"]},
        f"{name}sub0": {
            "ParameterName": "Highest sub-index supported",
            "DataType": "0x0005",
            "AccessType": "ro",
            "DefaultValue": str(entries),
        },
    }
    for subindex in range(1, entries + 1):
        key = str(subindex)
        sub = template | {"ParameterName": names.get(key, f"{head['ParameterName']} {key}")}
        if values.get(key):
            sub["ParameterValue"] = values[key]
        expanded[f"{name}sub{subindex:X}"] = sub
    return expanded


def _resolve_numbers(section: _Section, node_id: int) -> _Section:
    """Replace $NODEID and leading zeros in the numbers of a section."""
    if int(section.get("DataType") or "0", 0) in _NO_NUMBERS:
        return section
    numbers = {key: _resolve_number(section[key], node_id) for key in _NUMBERS if key in section}
    return section | numbers


def _resolve_number(text: str, node_id: int) -> str:
    terms = _NODE_ID.sub(str(node_id), text).replace(" ", "").split("+")
    terms = [f"0o{term}" if _OCTAL.fullmatch(term) else term for term in terms]
    return str(sum(int(term, 0) for term in terms)) if len(terms) > 1 else terms[0]


def _as_text(sections: _Sections) -> str:
    lines = []
    for name, section in sections.items():
        lines += [f"[{name}]", *(f"{key}={value}" for key, value in section.items())]
    return "\n".join(lines)

"""Every object of every dictionary, read and written at its limits and beyond, over SDO.

What an object is, is what the EDS says of it. The client is canopen's, its frames handed to the
drive directly.
"""

from __future__ import annotations

import io
import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from canopen.sdo import SdoClient
from simdrive_bench import NODE_ID, RESET_NODE, SDO_REQUEST, SDO_RESPONSE, Bench
from vendors import DICTIONARIES, OWN, ConfiguredBench, path_of

from canwall.eds import load_eds
from canwall.simdrive.communication.abort import AbortCode

WHOLE = (*datatypes.SIGNED_TYPES, *datatypes.UNSIGNED_TYPES)
NO_LENGTH = (
    datatypes.VISIBLE_STRING,
    datatypes.OCTET_STRING,
    datatypes.UNICODE_STRING,
    datatypes.DOMAIN,
)

DEVICE_STATE, INVALID = AbortCode.DEVICE_STATE, AbortCode.INVALID_VALUE
_PDO_COMMUNICATION = {
    0x1: {DEVICE_STATE, INVALID},  # COB-ID
    0x2: {INVALID},  # transmission type
    0x3: {DEVICE_STATE},  # inhibit time
    0x6: {DEVICE_STATE, INVALID},  # SYNC start value
}
_PDO_MAPPING = {DEVICE_STATE, AbortCode.NO_OBJECT, AbortCode.NOT_MAPPABLE, AbortCode.TOO_HIGH}
#: Abort codes for values within the limits of the EDS, by index, with the reason.
SERVED: dict[int, set[AbortCode]] = {
    0x1003: {INVALID},  # 0 clears the history, no other number means anything
    0x1005: {INVALID},
    0x1010: {AbortCode.NOT_STORED},  # "save" alone
    0x1011: {AbortCode.NOT_STORED},  # "load" alone
    0x1014: {INVALID, DEVICE_STATE},
    0x1016: {INVALID},
    0x1019: {INVALID, DEVICE_STATE},  # not while there is a cycle period
    0x1029: {INVALID},
    # Begins only what the other sub-indices describe; the kinds' highest number is the drive's own.
    0x5F00: {DEVICE_STATE, AbortCode.TOO_HIGH},
    0x6007: {INVALID},
    0x605A: {INVALID},
    0x605B: {INVALID},
    0x605C: {INVALID},
    0x605D: {INVALID},
    0x605E: {INVALID},
    0x6060: {INVALID},
    0x6098: {INVALID},
    0x60A9: {INVALID},
}


def served(variable: ODVariable) -> set[AbortCode]:
    """Return the codes with which a service may refuse what the EDS allows."""
    index = variable.index
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        return _PDO_COMMUNICATION.get(variable.subindex, set())
    if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00:
        return _PDO_MAPPING
    return SERVED.get(index, set())


@dataclass
class Wire:
    """canopen's network, as far as its SDO client wants one: a drive at the other end."""

    bench: Bench
    client: SdoClient

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        for answer_id, answer in self.bench.give(can_id, bytes(data)):
            if answer_id == SDO_RESPONSE:
                self.client.on_response(answer_id, bytearray(answer), 0.0)


class Client:
    """canopen's SDO client at a drive."""

    def __init__(self, bench: Bench) -> None:
        self.sdo = SdoClient(SDO_REQUEST, SDO_RESPONSE, canopen.ObjectDictionary())
        self.sdo.network = Wire(bench, self.sdo)

    def read(self, index: int, subindex: int) -> bytes | AbortCode:
        """Return the value, or the code that it was refused with."""
        try:
            data: bytes = self.sdo.upload(index, subindex)
        except canopen.SdoAbortedError as aborted:
            return AbortCode(aborted.code)
        return data

    def write(self, index: int, subindex: int, data: bytes, **how: bool) -> AbortCode | None:
        """Return the code that a value is refused with, None if it is not."""
        try:
            if how.pop("block", False):
                with self.sdo.open(
                    index, subindex, "wb", size=len(data), block_transfer=True, buffering=0
                ) as stream:
                    stream.write(data)
            else:
                self.sdo.download(index, subindex, data, **how)
        except canopen.SdoAbortedError as aborted:
            return AbortCode(aborted.code)
        return None


@pytest.fixture(scope="module", params=DICTIONARIES)
def bench(request: pytest.FixtureRequest) -> Bench:
    return ConfiguredBench(path_of(request.param))


@pytest.fixture
def client(bench: Bench) -> Client:
    bench.nmt(RESET_NODE)
    bench.tick()
    return Client(bench)


@pytest.fixture
def variables(bench: ConfiguredBench) -> list[ODVariable]:
    found: list[ODVariable] = []
    for item in load_eds(bench.path, NODE_ID).values():
        found += [item] if isinstance(item, ODVariable) else item.subindices.values()
    return [variable for variable in found if variable.index >= 0x1000]


def size_of(variable: ODVariable) -> int | None:
    """Return the bytes that the data type has, None for strings and domains."""
    return None if variable.data_type in NO_LENGTH else len(variable) // 8


def some_value(variable: ODVariable) -> bytes:
    return bytes(size_of(variable) or 5)


def test_read(client: Client, variables: list[ODVariable]) -> None:
    for variable in variables:
        got = client.read(variable.index, variable.subindex)
        size = size_of(variable)
        if variable.access_type == "wo":
            assert got is AbortCode.WRITE_ONLY, variable
        elif variable.index == 0x1003 and variable.subindex:
            assert got is AbortCode.NO_DATA, variable
        else:
            assert isinstance(got, bytes), variable
            assert size is None or len(got) == size, variable


def test_what_is_not_written(client: Client, variables: list[ODVariable]) -> None:
    fixed = [variable for variable in variables if variable.access_type in ("ro", "const")]
    assert fixed
    for variable in fixed:
        key, data = (variable.index, variable.subindex), some_value(variable)
        assert client.write(*key, data) is AbortCode.READ_ONLY, variable
        assert client.write(*key, data, force_segment=True) is AbortCode.READ_ONLY, variable
        assert client.write(*key, data, block=True) is AbortCode.READ_ONLY, variable


def test_wrong_length(client: Client, variables: list[ODVariable]) -> None:
    for variable in variables:
        size = size_of(variable)
        if size is None or "w" not in variable.access_type:
            continue
        key = variable.index, variable.subindex
        before = client.read(*key)
        for how in ({}, {"force_segment": True}, {"block": True}):
            for length, code in (
                (size - 1, AbortCode.TOO_SHORT),
                (size + 1, AbortCode.TOO_LONG),
                (size + 8, AbortCode.TOO_LONG),
            ):
                if length:
                    assert client.write(*key, bytes(length), **how) is code, (variable, how)
        assert client.read(*key) == before, variable


def attempts(variable: ODVariable) -> Iterator[tuple[bytes, AbortCode | None]]:
    """Return values at the limits and beyond, and the code that each of them gets."""
    size = size_of(variable)
    assert size is not None
    signed = variable.data_type in datatypes.SIGNED_TYPES
    smallest = -(1 << 8 * size - 1) if signed else 0
    largest = smallest + (1 << 8 * size) - 1
    low = smallest if variable.min is None else variable.min
    high = largest if variable.max is None else variable.max
    for value in (low - 1, low, high, high + 1):
        if smallest <= value <= largest:
            code = None
            if value < low:
                code = AbortCode.TOO_LOW
            elif value > high:
                code = AbortCode.TOO_HIGH
            yield value.to_bytes(size, "little", signed=signed), code


def test_limits(client: Client, variables: list[ODVariable]) -> None:
    written = 0
    for variable in variables:
        if "w" not in variable.access_type or variable.data_type not in WHOLE:
            continue
        key = variable.index, variable.subindex
        for data, code in attempts(variable):
            before = client.read(*key)
            got = client.write(*key, data)
            where = f"{variable} = {data.hex()}: {got!r}"
            if code is not None:
                assert got is code, where
            elif got is not None:
                assert got in served(variable), where
            if got is not None:
                assert client.read(*key) == before, where
            elif variable.access_type != "wo":
                assert client.read(*key) == data, where
            written += got is None
    assert written > 50


def test_other_types(client: Client, variables: list[ODVariable]) -> None:
    """Strings and domains of any length come back, and so do numbers with a fraction."""
    for variable in variables:
        if "w" not in variable.access_type or variable.data_type in WHOLE:
            continue
        samples = [b"\0\0\xc0\xbf", b"\0\0\0\0"]  # -1.5
        if variable.data_type in NO_LENGTH:
            samples = [b"", b"abc", b"of the user", bytes(range(256))]
        elif variable.data_type == datatypes.BOOLEAN:
            samples = [b"\1", b"\0"]
        for data in samples:
            key = variable.index, variable.subindex
            if variable.data_type in NO_LENGTH:
                assert client.write(*key, data, force_segment=True) is None, variable
            else:
                assert client.write(*key, data) is None, variable
            if variable.access_type != "wo":
                assert client.read(*key) == data, variable


def test_what_is_not_there(client: Client, variables: list[ODVariable]) -> None:
    present: dict[int, set[int]] = {}
    for variable in variables:
        present.setdefault(variable.index, set()).add(variable.subindex)
    for index, subindices in present.items():
        absent = next(n for n in range(256) if n not in subindices)
        for subindex in (absent, 255):
            assert client.read(index, subindex) is AbortCode.NO_SUBINDEX
            assert client.write(index, subindex, b"\0") is AbortCode.NO_SUBINDEX
    for index in (0, 5, *range(0x1000, 0x1400), *range(0x6000, 0x6700), 0xFFFF):
        if index not in present:
            assert client.read(index, 0) is AbortCode.NO_OBJECT
            assert client.write(index, 0, b"\0", block=True) is AbortCode.NO_OBJECT


def test_drive_is_the_same_afterwards(client: Client, bench: Bench) -> None:
    for index in (0x1000, 0x1018):
        assert isinstance(client.read(index, 0), bytes)
    assert bench.emergencies() == []


@pytest.mark.parametrize("size", [1, 6, 7, 8, 889, 890, 10_000, 1 << 16])
@pytest.mark.parametrize("crc", [True, False])
def test_block_transfer_of_64_kib_both_ways(size: int, crc: bool) -> None:
    client = Client(ConfiguredBench(path_of(OWN)))
    sent = random.Random(size).randbytes(size)
    with client.sdo.open(
        0x2100, 0, "wb", size=size, block_transfer=True, request_crc_support=crc
    ) as stream:
        stream.write(sent)
    stream: Any = client.sdo.open(0x2100, 0, "rb", block_transfer=True, request_crc_support=crc)
    with stream:
        assert stream.read() == sent
    assert isinstance(stream, io.BufferedReader)

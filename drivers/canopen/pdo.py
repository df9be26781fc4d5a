"""PDO mapping (CiA 301) from mapping words or an EDS, and the base of the decoders of a node's channels."""

from __future__ import annotations

import configparser
import io
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary, ObjectDictionaryError
from canopen.objectdictionary.eds import import_eds

from drivers.can.channel import too_short
from drivers.can.frame import DATA_MAX, EXTENDED_ID_MAX
from drivers.canopen.cia301 import tpdo_id
from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.files import read_whole
from drivers.jumps import JumpWatch
from drivers.readings import DeviceEvent, Record

_FILE_MAX_BYTES = 2 << 20
_BLANKS = re.compile(r"[^\S\n]+")
_COMMENT = re.compile(r"^\s*[#;].*|(?<=\s);.*")

TPDO_COMMUNICATION = 0x1800
TPDO_MAPPING = 0x1A00
COB_ID_DISABLED = 1 << 31
COB_ID_EXTENDED = 1 << 29


@dataclass(frozen=True, slots=True)
class PdoField:
    """The position of one object in a PDO. Bits count from the least significant bit of byte 0 (little endian).

    Attributes:
        index, subindex: the object.
        first_bit, length_bits: its position.
    """

    index: int
    subindex: int
    first_bit: int
    length_bits: int

    @property
    def end_bit(self) -> int:
        """The first bit after the field; a PDO with fewer bits than this does not contain it."""
        return self.first_bit + self.length_bits

    @property
    def word(self) -> int:
        """The mapping entry in the format of object 1A0xh: index, sub-index, length."""
        return self.index << 16 | self.subindex << 8 | self.length_bits

    def extract(self, bits: int) -> int:
        """Return the field as an unsigned integer; `bits` is the whole PDO as a little-endian integer."""
        return bits >> self.first_bit & ((1 << self.length_bits) - 1)

    def extract_signed(self, bits: int) -> int:
        """Return the field as a signed integer (two's complement)."""
        half = 1 << self.length_bits - 1
        return (self.extract(bits) ^ half) - half


@dataclass(frozen=True, slots=True)
class PdoMapping:
    """Fields of a PDO, in order."""

    fields: tuple[PdoField, ...]

    @classmethod
    def from_words(cls, words: Iterable[int], where: str) -> PdoMapping:
        """Read the 32-bit entries of object 1A0xh, sub-indices 1 and up (`60040020h`: object 6004h.0, 32 bits).

        Raises:
            DescriptionError: there is no entry, an entry has no bits, or there are more than 64 bits in total.
        """
        fields = []
        first_bit = 0
        for word in words:
            field = PdoField(word >> 16 & 0xFFFF, word >> 8 & 0xFF, first_bit, word & 0xFF)
            if not 0 <= word <= 0xFFFFFFFF or field.length_bits == 0:
                raise DescriptionError(where, f"PDO mapping entry {word:08X}h is not index, sub-index and length")
            first_bit = field.end_bit
            fields.append(field)
        if not fields:
            raise DescriptionError(where, "the PDO mapping has no entries")
        if first_bit > 8 * DATA_MAX:
            raise DescriptionError(where, f"the PDO mapping has {first_bit} bits; a frame has {8 * DATA_MAX}")
        return cls(tuple(fields))

    def find(self, index: int) -> PdoField | None:
        """Return the first field with an object of this index and any sub-index; None if the PDO has none."""
        return next((field for field in self.fields if field.index == index), None)

    @property
    def words(self) -> tuple[int, ...]:
        """The mapping entries in the format of object 1A0xh."""
        return tuple(field.word for field in self.fields)


@dataclass(frozen=True, slots=True)
class TransmitPdo:
    """A TPDO as it appears on the bus.

    Attributes:
        arbitration_id, is_extended: its COB-ID.
        mapping: the objects that it contains.
    """

    arbitration_id: int
    is_extended: bool
    mapping: PdoMapping

    @classmethod
    def usual(cls, node: int, number: int, words: Iterable[int]) -> TransmitPdo:
        """Make TPDO `number` (1 to 4) of the pre-defined connection set with a mapping given as words.

        Raises:
            DescriptionError: see `PdoMapping.from_words`.
        """
        where = f"node {node}, TPDO{number}"
        return cls(tpdo_id(node, number), False, PdoMapping.from_words(words, where))

    @classmethod
    def from_eds(cls, path: Path, node: int, number: int) -> TransmitPdo:
        """Read a node's TPDO from an EDS or DCF.

        Args:
            path: the file.
            node: CANopen node number.
            number: number of the TPDO, counted from 1.

        Raises:
            DescriptionError: the file is missing or malformed, or has no such TPDO; the message names the object.
        """
        where = str(path)
        dictionary = _import(path, node)
        cob_id = _value(dictionary, where, TPDO_COMMUNICATION + number - 1, 1)
        entries = _value(dictionary, where, TPDO_MAPPING + number - 1, 0)
        if not 0 <= entries <= 8 * DATA_MAX:
            raise DescriptionError(where, f"object {TPDO_MAPPING + number - 1:04X}h.0: {entries} mapping entries")
        words = [_value(dictionary, where, TPDO_MAPPING + number - 1, entry) for entry in range(1, entries + 1)]
        is_extended = bool(cob_id & COB_ID_EXTENDED)
        arbitration_id = cob_id & (EXTENDED_ID_MAX if is_extended else 0x7FF)
        return cls(arbitration_id, is_extended, PdoMapping.from_words(words, f"{where}: TPDO{number}"))

    def decoding(self, index: int) -> str:
        """Return one line that describes where an object is found on the bus, regardless of the PDO's other objects."""
        frame = f"frame {self.arbitration_id:08X}h" if self.is_extended else f"frame {self.arbitration_id:03X}h"
        field = self.mapping.find(index)
        if field is None:
            return f"{frame}, without object {index:04X}h"
        return f"{frame}, {field.length_bits} bits from bit {field.first_bit}, object {index:04X}h.{field.subindex}"


@dataclass(frozen=True, kw_only=True)
class PdoChannel:
    """Settings common to all channels in a node's TPDO.

    Attributes:
        name: name of the joint or signal.
        unit: unit of the value.
        node: CANopen node number.
        pdo: the TPDO that contains the value.
        pdo_number: number of that TPDO, 1 to 4.
        is_synchronous: the value is sampled at SYNC, so its readings get the instant of the preceding SYNC.
        heartbeat_ms: the node's heartbeat producer time; 0 for no heartbeat.
        timeout_s: silence longer than this is a gap.
    """

    name: str
    unit: str
    node: int
    pdo: TransmitPdo
    pdo_number: int = 1
    is_synchronous: bool = False
    heartbeat_ms: int = 1000
    timeout_s: float = 1.0

    def does_not_carry(self, what: str) -> str:
        """Return the error text for a TPDO that lacks the channel's object."""
        words = " ".join(f"{word:08X}" for word in self.pdo.mapping.words)
        return f"TPDO{self.pdo_number} of node {self.node} does not contain {what}; its mapping is {words}"


class PdoChannelDecoder:
    """Base of the decoders of CANopen channels.

    Attributes:
        is_void: the node has an emergency that makes its values invalid (set by the supervision of the node).
    """

    missed_frames: int | None = None  # PDOs have no counter

    def __init__(self, channel: PdoChannel) -> None:
        self.name = channel.name
        self.node = channel.node
        self.arbitration_id = channel.pdo.arbitration_id
        self.is_extended = channel.pdo.is_extended
        self.is_synchronous = channel.is_synchronous
        self.heartbeat_ms = channel.heartbeat_ms
        self.timeout_s = channel.timeout_s
        self.is_void = False
        self._unit = channel.unit
        self._jumps: JumpWatch | None = None

    def object_read(self, stamp: Stamp, index: int, value: int) -> list[Record]:  # noqa: ARG002 - profiles use them
        """Return the records caused by an object of the node that was read over SDO.

        Args:
            stamp: when the answer was received.
            index: index of the object.
            value: its content as an unsigned integer.
        """
        return []

    def recall(self, event: DeviceEvent) -> bool:  # noqa: ARG002 - profiles use it
        """Restore alarms or warnings from an event of an earlier decoder of the channel; True if any were restored."""
        return False

    def node_restarted(self) -> None:
        """Discard the node's last known state, because the node has booted."""
        self.is_void = False

    def _too_short(self, stamp: Stamp, data: bytes, needed_bits: int) -> list[Record]:
        return too_short(self.name, self._unit, stamp, data, needed_bits, self._jumps)


def _import(path: Path, node: int) -> ObjectDictionary:
    try:
        # CiA 306 prescribes ASCII, but some manufacturers use Latin-1 in names
        text = io.StringIO(read_whole(path, _FILE_MAX_BYTES).decode("latin-1"), newline=None).read()
        # The time that configparser takes for a run of blanks grows with the square of its length
        text = _BLANKS.sub(" ", text)
        if (number := _first_bad_line(text)) is not None:
            raise DescriptionError(str(path), f"not a valid EDS: line {number} is neither [section] nor name=value")
        # As text, because from a file named .epf canopen would read XML
        dictionary: ObjectDictionary = import_eds(io.StringIO(text), node)  # type: ignore[no-untyped-call]
        return dictionary
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error
    except configparser.Error as error:
        raise DescriptionError(str(path), f"not a valid EDS: {' '.join(str(error).split())}") from error
    # Exceptions that canopen lets escape when it parses numbers, sections and sub-objects
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, ObjectDictionaryError) as error:
        raise DescriptionError(str(path), f"not a valid EDS: {error}") from error


def _first_bad_line(text: str) -> int | None:
    """Return the number of the first line that configparser cannot read; None if there is none in a section.

    configparser itself collects all such lines, in a time that grows with the square of their number. Before the first
    section it stops at the first one.
    """
    parser = configparser.RawConfigParser
    is_in_section = False
    option_indent: int | None = None  # a line that is indented deeper than an option continues its value
    for number, line in enumerate(text.split("\n"), start=1):
        content = _COMMENT.sub("", line).strip()
        indent = len(line) - len(line.lstrip())
        if not content or (option_indent is not None and indent > option_indent):
            continue
        if parser.SECTCRE.match(content):
            is_in_section, option_indent = True, None
        elif not is_in_section:
            return None
        elif (option := parser.OPTCRE.match(content)) is not None and option["option"]:
            option_indent = indent
        else:
            return number
    return None


def _value(dictionary: ObjectDictionary, where: str, index: int, subindex: int) -> int:
    place = f"object {index:04X}h.{subindex}"
    variable = dictionary.get_variable(index, subindex)
    if variable is None:
        raise DescriptionError(where, f"{place} is not described")
    value = variable.default if variable.value is None else variable.value
    if not isinstance(value, int):
        raise DescriptionError(where, f"{place} has no DefaultValue or ParameterValue that is a number")
    return value

"""PDO mapping (CiA 301) from mapping words or an EDS."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from drivers.can.frame import DATA_MAX, EXTENDED_ID_MAX
from drivers.canopen.cia301 import tpdo_id
from drivers.canopen.eds import number_of, read_eds
from drivers.errors import DescriptionError

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
        dictionary = read_eds(path, node)
        cob_id = number_of(dictionary, where, TPDO_COMMUNICATION + number - 1, 1)
        entries = number_of(dictionary, where, TPDO_MAPPING + number - 1, 0)
        if not 0 <= entries <= 8 * DATA_MAX:
            raise DescriptionError(where, f"object {TPDO_MAPPING + number - 1:04X}h.0: {entries} mapping entries")
        words = [number_of(dictionary, where, TPDO_MAPPING + number - 1, entry) for entry in range(1, entries + 1)]
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

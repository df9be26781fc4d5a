"""Electronic data sheets (EDS, CiA 306): the objects of a node, read by canopen after checks of what it cannot take."""

from __future__ import annotations

import configparser
import io
import re
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary, ObjectDictionaryError
from canopen.objectdictionary.eds import import_eds

from drivers.errors import DescriptionError
from drivers.files import read_whole

_FILE_MAX_BYTES = 2 << 20
_BLANKS = re.compile(r"[^\S\n]+")
_COMMENT = re.compile(r"^\s*[#;].*|(?<=\s);.*")


def read_eds(path: Path, node: int) -> ObjectDictionary:
    """Read the object dictionary of a node from an EDS or DCF file.

    Raises:
        DescriptionError: the file cannot be read or is no valid EDS; names the file and the reason.
    """
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


def number_of(dictionary: ObjectDictionary, where: str, index: int, subindex: int) -> int:
    """Return the value of an object that an EDS describes, or its default.

    Args:
        dictionary: from `read_eds`.
        where: file, for the error message.
        index: index of the object.
        subindex: its sub-index.

    Raises:
        DescriptionError: the file does not describe the object, or gives it no number.
    """
    place = f"object {index:04X}h.{subindex}"
    variable = dictionary.get_variable(index, subindex)
    if variable is None:
        raise DescriptionError(where, f"{place} is not described")
    value = variable.default if variable.value is None else variable.value
    if not isinstance(value, int):
        raise DescriptionError(where, f"{place} has no DefaultValue or ParameterValue that is a number")
    return value

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.sdo import (
    UPLOAD_MAX_BYTES,
    AbortResponse,
    Download,
    DownloadResponse,
    SdoAbortError,
    SdoExchange,
    Transfer,
    Upload,
    UploadResponse,
    decode_response,
    encode_download,
)
from drivers.errors import DeviceError


def exchange(transfer: Transfer) -> SdoExchange:
    return SdoExchange("theta1 (node 32)", transfer)


def test_expedited_read_of_the_protocol_facts() -> None:
    reading = exchange(Upload(0x6004, 0))
    assert reading.request.hex() == "4004600000000000"
    assert reading.feed(bytes.fromhex("430460004E61BC00")) is False
    assert reading.result is not None
    assert int.from_bytes(reading.result, "little") == 12345678


@pytest.mark.parametrize(("command", "length"), [("4F", 1), ("4B", 2), ("47", 3), ("43", 4), ("42", 4)])
def test_expedited_answers_of_every_length(command: str, length: int) -> None:
    response = decode_response(bytes.fromhex(command + "01600011223344"))
    assert response == UploadResponse(0x6001, 0, bytes.fromhex("11223344")[:length])


@pytest.mark.parametrize(("command", "data"), [("2f", "01"), ("2b", "0102"), ("27", "010203"), ("23", "01020304")])
def test_expedited_writes_of_every_length(command: str, data: str) -> None:
    assert encode_download(0x1800, 5, bytes.fromhex(data)).hex() == command + "001805" + data.ljust(8, "0")


@pytest.mark.parametrize("data", [b"", bytes(5)])
def test_a_write_that_is_not_expedited_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="1 to 4 bytes"):
        encode_download(0x1800, 5, data)


def test_write_answers_of_the_protocol_facts() -> None:
    assert decode_response(bytes.fromhex("6003600000000000")) == DownloadResponse(0x6003, 0)
    assert decode_response(bytes.fromhex("6000180500000000")) == DownloadResponse(0x1800, 5)
    assert decode_response(bytes.fromhex("6000300000000000")) == DownloadResponse(0x3000, 0)


@pytest.mark.parametrize(
    ("write", "request_", "answer"),
    [
        (Download(0x6003, 0, (7200).to_bytes(4, "little")), "23036000201C0000", "6003600000000000"),
        (Download(0x1800, 5, (100).to_bytes(2, "little")), "2B00180564000000", "6000180500000000"),
        (Download(0x3000, 0, b"\x0a"), "2F0030000A000000", "6000300000000000"),
        (Download(0x3001, 0, b"\x05"), "2F01300005000000", "6001300000000000"),
    ],
)
def test_the_worked_writes_are_sent_with_their_size_and_done_when_answered(
    write: Download, request_: str, answer: str
) -> None:
    """The manual's examples leave the size unsaid (22h); the answer to either is the same."""
    writing = exchange(write)
    assert writing.request == bytes.fromhex(request_)
    assert writing.feed(bytes.fromhex(answer)) is False
    assert writing.result == b""


def test_abort_of_the_protocol_facts() -> None:
    data = bytes.fromhex("8054760000000206")
    assert decode_response(data) == AbortResponse(0x7654, 0, 0x06020000)
    with pytest.raises(SdoAbortError, match=r"theta1 \(node 32\): reading 7654h.0 .* 06020000h, object does not exist"):
        exchange(Upload(0x7654, 0)).feed(data)


def test_an_unknown_abort_code_is_named_by_number() -> None:
    with pytest.raises(SdoAbortError, match=r"writing 05 to 1017h.0 .* 12345678h, unknown abort code"):
        exchange(Download(0x1017, 0, b"\x05")).feed(bytes.fromhex("8017100078563412"))


def test_a_segmented_read_is_put_together() -> None:
    text = b"SIM-CIA406 long name"
    reading = exchange(Upload(0x1008, 0))
    assert reading.feed(bytes.fromhex("4108100014000000"))
    toggles = []
    for start in range(0, len(text), 7):
        toggles.append(reading.request[0])
        part = text[start : start + 7]
        is_last = start + 7 >= len(text)
        command = (len(toggles) - 1) % 2 << 4 | (7 - len(part)) << 1 | is_last
        assert reading.feed(bytes((command,)) + part.ljust(7, b"\0")) is not is_last
    assert toggles == [0x60, 0x70, 0x60]
    assert reading.result == text


def test_a_segment_with_the_wrong_toggle_is_passed_over() -> None:
    reading = exchange(Upload(0x1008, 0))
    reading.feed(bytes.fromhex("4108100014000000"))
    assert reading.feed(bytes.fromhex("1041414141414141")) is False
    assert reading.result is None
    assert reading.request[0] == 0x60


def test_a_repeated_answer_does_not_restart_the_segments() -> None:
    reading = exchange(Upload(0x1008, 0))
    reading.feed(bytes.fromhex("4108100014000000"))
    reading.feed(bytes.fromhex("0041414141414141"))
    assert reading.feed(bytes.fromhex("4108100014000000")) is False
    reading.feed(bytes.fromhex("1D42000000000000"))
    assert reading.result == b"AAAAAAAB"


def test_answers_to_others_are_passed_over() -> None:
    reading = exchange(Upload(0x6001, 0))
    for answer in ("430260000000A000", "6001600000000000", "4F01600100000000", "0141414141414141", "A400000000000000"):
        assert reading.feed(bytes.fromhex(answer)) is False
    writing = exchange(Download(0x6001, 0, b"\x01"))
    assert writing.feed(bytes.fromhex("4301600000000000")) is False
    assert reading.result is None
    assert writing.result is None


def test_a_node_that_never_ends_is_given_up() -> None:
    reading = exchange(Upload(0x1008, 0))
    reading.feed(bytes.fromhex("4108100000000000"))
    with pytest.raises(DeviceError, match="more than 4096 bytes"):  # noqa: PT012 - the last of many feeds raises
        for segment in range(UPLOAD_MAX_BYTES):
            reading.feed(bytes((segment % 2 << 4,)) + bytes(7))


@given(st.lists(st.binary(max_size=9), max_size=20), st.booleans())
def test_nothing_a_node_sends_is_worse_than_a_device_error(messages: list[bytes], reads: bool) -> None:
    transfer = exchange(Upload(0, 0) if reads else Download(0, 0, b"\0"))
    for data in messages:
        try:
            transfer.feed(data)
        except DeviceError:
            break

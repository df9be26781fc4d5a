"""When a link may be asked to set nodes up: only while it is open, and never later than it was asked."""

from __future__ import annotations

import can
import pytest

from drivers.canopen.node_setup import PROFILE_ENCODER, NodeSetup
from drivers.canopen.pdo import TransmitPdo
from drivers.errors import DeviceError, TransmitForbiddenError
from drivers.readings import EventKind
from tests.drivers.can_support import (
    Adapter,
    running,
    slcan_link,
    unused_channel,
    virtual_bus,
    virtual_link,
)


def setup(node: int = 32, name: str = "theta1") -> NodeSetup:
    return NodeSetup(
        node=node,
        name=name,
        profile=PROFILE_ENCODER,
        pdo=TransmitPdo.usual(node, 1, (0x60040020,)),
        mode="sync",
        period_ms=20,
        heartbeat_ms=1000,
    )


BOTH = {"allow_transmit": True, "transmit_nodes": (32, 33), "setups": [setup(), setup(33, "theta3")]}


def test_a_request_before_the_link_is_open_fails_and_is_not_kept_for_later() -> None:
    channel = unused_channel()
    link = virtual_link(channel, **BOTH)
    with pytest.raises(
        DeviceError, match=r"^boom: nodes cannot be set up while the link is not open; try again when it is"
    ):
        link.request_setup()
    with virtual_bus(channel) as bus, running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        bus.send(can.Message(arbitration_id=0x333, is_extended_id=False))
        heard.wait(lambda: heard.received, "a frame")
        # A request is taken before the next read: had one been kept, it would have been sent by now
        bus.send(can.Message(arbitration_id=0x334, is_extended_id=False))
        heard.wait(lambda: len(heard.received) == 2, "another frame")
    assert heard.sent == []


def test_a_request_while_the_link_is_lost_fails_and_nothing_is_sent_when_it_is_back(adapter: Adapter) -> None:
    link = slcan_link(adapter, **BOTH)
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.unplug()
        heard.wait_for(EventKind.LINK_LOST)
        with pytest.raises(DeviceError, match="the link is not open"):
            link.request_setup()
        with pytest.raises(DeviceError, match="the link is not open"):
            link.check_setup()
        adapter.plug_in()
        heard.wait_for(EventKind.LINK_UP, 2)
        adapter.send(b"t1A01BB\r")
        heard.wait(lambda: heard.received, "a frame after the return")
        link.check_setup()
    assert heard.sent == []


def test_an_unfinished_set_up_ends_with_the_link_and_is_not_taken_up_again(adapter: Adapter) -> None:
    link = slcan_link(adapter, **BOTH)
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        link.request_setup()
        adapter.commands(b"t62084000100000000000\r")
        heard.wait(lambda: heard.sent, "the first request")
        adapter.unplug()
        heard.wait_for(EventKind.LINK_LOST)
        heard.wait_for(EventKind.ALARM, 2)
        sent = len(heard.sent)
        adapter.plug_in()
        heard.wait_for(EventKind.LINK_UP, 2)
        adapter.send(b"t1A01BB\r")
        heard.wait(lambda: heard.received, "a frame after the return")
    first, second = heard.events(EventKind.ALARM)
    assert (first.device, second.device) == ("theta1", "theta3")
    assert first.text == (
        "node 32: set-up was interrupted and may be incomplete because the link was lost; request it again"
    )
    assert second.text == "node 33: set-up was not started because the link was lost; request it again"
    assert len(heard.sent) == sent


def test_a_set_up_that_stopping_cuts_short_says_so_and_is_not_taken_up_by_the_next_run() -> None:
    link = virtual_link(unused_channel(), **BOTH)
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        link.request_setup([33])
        heard.wait(lambda: heard.sent, "a request to the node")
    (alarm,) = heard.events(EventKind.ALARM)
    assert "because rigcal was stopped" in alarm.text
    with pytest.raises(DeviceError, match="the link is not open"):
        link.request_setup()
    with running(link) as again:
        again.wait_for(EventKind.LINK_UP)
        link.check_setup()
    assert again.sent == []


def test_a_check_raises_what_a_request_would_and_asks_for_nothing() -> None:
    listening = virtual_link(unused_channel(), setups=[setup()])
    with pytest.raises(TransmitForbiddenError, match="listen-only"):
        listening.check_setup()
    one_listed = virtual_link(unused_channel(), **(BOTH | {"transmit_nodes": (32,)}))
    with pytest.raises(TransmitForbiddenError, match="node 33 is not listed"):
        one_listed.check_setup()
    link = virtual_link(unused_channel(), **BOTH)
    with pytest.raises(DeviceError, match="the rig file has no channel on node 34"):
        link.check_setup([32, 34])
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        link.check_setup()
        with pytest.raises(DeviceError, match="node 34"):
            link.request_setup([32, 34])
        # What is asked for next is first: nothing was waiting before it
        link.request_setup([33])
        heard.wait(lambda: heard.sent, "a request to a node")
    assert {frame.arbitration_id for frame in heard.sent} == {0x621}


def test_a_link_tells_which_nodes_it_may_set_up() -> None:
    one_listed = virtual_link(unused_channel(), **(BOTH | {"transmit_nodes": (32,)}))
    assert (one_listed.setup_nodes(permitted=True), one_listed.setup_nodes(permitted=False)) == ([32], [33])
    listening = virtual_link(unused_channel(), setups=[setup()])
    assert (listening.setup_nodes(permitted=True), listening.setup_nodes(permitted=False)) == ([], [32])


def test_a_link_tells_whether_it_has_nodes_to_set_up() -> None:
    assert virtual_link(unused_channel(), **BOTH).has_setups
    assert not virtual_link(unused_channel()).has_setups


def test_a_simulated_machine_is_set_up_at_the_first_opening_and_at_no_other(adapter: Adapter) -> None:
    link = slcan_link(adapter, **BOTH, configure_at_start=True)
    with running(link) as heard:
        adapter.commands(b"t62084000100000000000\r")
        heard.wait(lambda: heard.sent, "the first request")
        adapter.unplug()
        heard.wait_for(EventKind.ALARM, 2)
        sent = len(heard.sent)
        adapter.plug_in()
        heard.wait_for(EventKind.LINK_UP, 2)
        adapter.send(b"t1A01BB\r")
        heard.wait(lambda: heard.received, "a frame after the return")
    assert {frame.arbitration_id for frame in heard.sent} == {0x620}
    assert len(heard.sent) == sent


def test_a_set_up_at_the_start_waits_for_the_first_opening(adapter: Adapter) -> None:
    adapter.unplug()
    link = slcan_link(adapter, **BOTH, configure_at_start=True)
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_LOST)
        adapter.plug_in()
        heard.wait_for(EventKind.LINK_UP)
        adapter.commands(b"t62084000100000000000\r")


def test_a_set_up_at_the_start_that_is_not_allowed_is_refused_before_anything_is_opened() -> None:
    with pytest.raises(TransmitForbiddenError, match="listen-only"):
        virtual_link(unused_channel(), setups=[setup()], configure_at_start=True)
    with pytest.raises(TransmitForbiddenError, match="node 33 is not listed"):
        virtual_link(unused_channel(), **(BOTH | {"transmit_nodes": (32,)}), configure_at_start=True)
    assert not virtual_link(unused_channel(), configure_at_start=True).has_setups

"""An operator lets rigcal set up the nodes that it may set up."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.commands import CommandError
from daemon.control.protocol import request
from drivers.can_link import CanLink
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.idle_daemon import idle_daemon
from tests.drivers.can_support import unused_channel, virtual_link
from tests.drivers.canopen.test_can_setup_requests import BOTH


def told(tmp_path: Path, *links: CanLink) -> str:
    """The answer of a daemon with these links to `rigcal devices configure`."""
    with idle_daemon(tmp_path, links=links) as config:
        wait_until(lambda: all(link.read_until is not None for link in links))
        answer: str = request(config.socket_path, "devices.configure", {"machine_is_parked": True})["text"]
        return answer


def test_nodes_that_may_not_be_set_up_keep_no_others_from_it(tmp_path: Path) -> None:
    one_listed = virtual_link(unused_channel(), **(BOTH | {"transmit_nodes": (33,)}))
    assert told(tmp_path, one_listed) == (
        "the nodes on boom are being set up; `rigcal status` shows the result; "
        "not set up, because the configuration does not allow it: node 32 on boom"
    )


def test_a_listen_only_link_keeps_no_other_from_being_set_up(tmp_path: Path) -> None:
    listening = virtual_link(unused_channel(), setups=BOTH["setups"])
    listening.name = "base"
    answer = told(tmp_path, listening, virtual_link(unused_channel(), **BOTH))
    assert answer.startswith("the nodes on boom are being set up")
    assert answer.endswith("not set up, because the configuration does not allow it: node 32 on base, 33 on base")


def test_where_no_node_may_be_set_up_the_reason_is_told(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match="the link is listen-only"):
        told(tmp_path, virtual_link(unused_channel(), setups=BOTH["setups"]))

"""Commands of the control socket: maps each name to the part that carries it out, and creates the sockets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from daemon.acquisition.redecoding import redecode_command
from daemon.alarms.board import AlarmBoard
from daemon.commands import FAILED, REFUSED, CommandError, Handler, raise_if_cancelled, reading_socket, text_argument
from daemon.composition import Parts
from daemon.config.config import Config
from daemon.control.command_table import COMMANDS, checked_arguments
from daemon.control.protocol import reading_only
from daemon.control.server import ControlServer
from daemon.guide.manager import GuideManager
from daemon.jobs.runner import JobRunner
from daemon.models.live_tip import LiveTip
from daemon.models.registry import ModelRegistry
from daemon.monitoring.notices import Notices
from daemon.overview import Overview
from daemon.sessions.manager import SessionManager
from daemon.sessions.station_setups import StationSetups
from daemon.store.errors import unwritable_errors
from daemon.store.health import StoreHealth
from daemon.store.store import Store
from daemon.store.upkeep.housekeeping import Housekeeping
from drivers.errors import DeviceError, TransmitForbiddenError

GUARDED = (
    "setup.new",
    "session.start",
    "session.stop",
    "session.abort",
    "session.shoot",
)  # refused while a guide is open
ENDING = ("session.stop", "session.abort")
# Carried out also while the store's file is missing or replaced: they end or carry on what is open, or store nothing.
UNGUARDED = (
    *ENDING,
    "session.shoot",
    "session.confirm-prism",
    "guide.done",
    "guide.skip",
    "guide.more",
    "guide.stop",
    "jobs.cancel",
    "alarms.test-notice",
    "devices.configure",
    "simulation.visit",
    "simulation.aim",
)


@dataclass(frozen=True)
class Commands:
    """All commands of a running daemon.

    Attributes:
        parts: links, decoders and actuators of the rig.
        store: open for writing.
        store_health: returns the state of the store.
        housekeeping, setups, sessions, jobs, models, tip, alarms, notices, guide, overview: parts that carry out the
            commands.
    """

    parts: Parts
    store: Store
    store_health: Callable[[], StoreHealth]
    housekeeping: Housekeeping
    setups: StationSetups
    sessions: SessionManager
    jobs: JobRunner
    models: ModelRegistry
    tip: LiveTip
    alarms: AlarmBoard
    notices: Notices
    guide: GuideManager
    overview: Overview

    def handlers(self) -> Mapping[str, Handler]:
        """Return command name -> its handler."""
        sessions, jobs, models = self.sessions, self.jobs, self.models
        commands: dict[str, Handler] = {
            "status": self.overview.command,
            "rig.show": self._show_rig,
            "setup.new": self.setups.new_command,
            "setup.list": self.setups.list_command,
            "session.start": sessions.start_command,
            "session.stop": sessions.stop_command,
            "session.abort": sessions.abort_command,
            "session.shoot": sessions.shoot_command,
            "session.confirm-prism": sessions.confirm_prism_command,
            "session.accept": sessions.accept_command,
            "session.reject": sessions.reject_command,
            "session.list": sessions.list_command,
            "session.show": sessions.show_command,
            "jobs.list": jobs.list_command,
            "jobs.cancel": jobs.cancel_command,
            "jobs.retry": jobs.retry_command,
            "model.list": models.list_command,
            "model.show": models.show_command,
            "model.accept": models.accept_command,
            "model.reject": models.reject_command,
            "model.rollback": models.rollback_command,
            "model.zeros-checked": models.zeros_checked_command,
            "model.compare": models.compare_command,
            "tip": self.tip.tip_command,
            "alarms.list": self.alarms.list_command,
            "alarms.test-notice": self.notices.try_command,
            "devices.configure": self._configure_devices,
            "store.prune": self._prune,
            "store.redecode": self._redecode,
            "guide.start": self.guide.start_command,
            "guide.state": self.guide.state_command,
            "guide.done": self.guide.done_command,
            "guide.skip": self.guide.skip_command,
            "guide.more": self.guide.more_command,
            "guide.stop": self.guide.stop_command,
            "simulation.visit": self._visit,
            "simulation.aim": self._turn,
        }
        commands |= {name: self.guide.guarding(name, commands[name]) for name in GUARDED}
        return {name: partial(self._carry_out, name, handler) for name, handler in commands.items()}

    def _carry_out(self, name: str, handler: Handler, arguments: Mapping[str, Any]) -> Any:
        given, health = checked_arguments(name, arguments), self.store_health()
        is_kept = health.state not in ("missing", "replaced")
        if not is_kept and COMMANDS[name].changes and name not in UNGUARDED:
            raise CommandError(f"not carried out: {health.text}", REFUSED)
        with unwritable_errors(self.store.path):
            answer = handler(given)
        if not is_kept and name in ENDING:
            lost = f"what is stored now, also this end of the session, may be lost when the daemon stops: {health.text}"
            answer |= {"advice": [*answer.get("advice", ()), lost]}
        return answer

    def _show_rig(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the rig's name and the text of its rig file."""
        return {"rig": self.parts.rig.name, "text": self.parts.rig_text}

    def _turn(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Turn the simulated station to a prism or a control point."""
        target = text_argument(arguments, "target")
        if self.parts.turn is None:
            raise _not_by_hand("station")
        self.parts.turn(target)
        return {"target": target}

    def _visit(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Send the simulated boom to the rows of a pose plan; `left` is the number of remaining stops."""
        rows = arguments.get("poses", [])
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise CommandError("poses: must be rows of a plan, as printed by `rigcal plan --json`")
        if self.parts.visit is None:
            raise _not_by_hand("boom")
        return {"left": self.parts.visit(rows)}

    def _prune(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Delete captures and readings outside sessions that are older than a number of days."""
        return self.housekeeping.prune_command(arguments, raise_if_cancelled)

    def _redecode(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Decode the raw captures of a session or of a time span again into readings and fixes."""
        return redecode_command(self.store, self.parts.rig, self.parts.decoders, arguments, raise_if_cancelled)

    def _configure_devices(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Set up CANopen devices, if the operator confirms that the machine is parked."""
        if arguments.get("machine_is_parked") is not True:
            raise CommandError(
                "set-up writes to devices; confirm with --machine-is-parked that the machine is parked and locked out"
            )
        links = [link for link in self.parts.can_links if link.has_setups]
        if not links:
            raise CommandError("no CAN link of this rig has CANopen nodes to set up")
        wanted = {link: nodes for link in links if (nodes := link.setup_nodes(permitted=True))}
        try:
            if not wanted:
                links[0].check_setup()  # refused, with the reason
            for link, nodes in wanted.items():
                link.check_setup(nodes)  # check all before any is set up, so that nothing is left half done
            for link, nodes in wanted.items():
                link.request_setup(nodes)
        except TransmitForbiddenError as error:
            raise CommandError(f"{error}; set-up needs allow_transmit = true and transmit_nodes", REFUSED) from error
        except DeviceError as error:
            raise CommandError(str(error), FAILED) from error
        names = ", ".join(link.name for link in wanted)
        text = f"the nodes on {names} are being set up; `rigcal status` shows the result"
        forbidden = [f"{node} on {link.name}" for link in links for node in link.setup_nodes(permitted=False)]
        if forbidden:
            text += f"; not set up, because the configuration does not allow it: node {', '.join(forbidden)}"
        return {"links": names, "text": text}


def control_servers(config: Config, commands: Mapping[str, Handler]) -> tuple[list[ControlServer], dict[str, str]]:
    """Start the control socket, and the read-only socket if a `read_group` is configured.

    Args:
        config: of the daemon.
        commands: command name -> its handler.

    Returns:
        The servers, and socket name -> reason for a socket that could not be created.

    Raises:
        CommandError: the control socket cannot be created.
    """
    servers, unserved = [ControlServer(config.socket_path, commands)], {}
    if config.read_group is not None:
        path = reading_socket(config.socket_path)
        try:
            servers.append(ControlServer(path, reading_only(commands, config.socket_path), group=config.read_group))
        except CommandError as error:
            unserved[path.name] = f"members of read_group {config.read_group} cannot connect: {error}"
    return servers, unserved


def _not_by_hand(what: str) -> CommandError:
    by_hand = "only a simulated rig started with `rigcal run --sim --by-hand` can"
    return CommandError(f"the {what} cannot be moved by command: {by_hand}", REFUSED)

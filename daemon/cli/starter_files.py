"""The commented configuration and rig file that `rigcal init` writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calibration.rig.toml import quoted
from daemon.cli.listening import HeardBus
from drivers.stations.serial_port import SerialConfig

_IDENTIFIERS_SHOWN = 40


@dataclass(frozen=True)
class JointChoice:
    """A joint of a new rig file.

    Attributes:
        name: of the joint.
        kind: revolute or prismatic.
        limits: lowest and highest reading, deg or mm.
        node: CANopen node of its encoder.
    """

    name: str
    kind: str
    limits: tuple[float, float]
    node: int

    @property
    def unit(self) -> str:
        """Unit of its readings."""
        return "deg" if self.kind == "revolute" else "mm"


def configuration(
    rig: str, interface: str, channel: str, bitrate: int | None, station: tuple[str, str, SerialConfig] | None
) -> str:
    """Return a configuration of the daemon.

    Args:
        rig: name or file name of the rig.
        interface: name of the python-can interface.
        channel: of that interface.
        bitrate: bit/s; None if the system sets it.
        station: profile, family to listen to and port of the total station; None for no station.
    """
    rate = f"bitrate = {bitrate}\n" if bitrate is not None else ""
    text = f"""# The daemon's configuration. Check it after every change:  rigcal config check FILE
# All keys: docs/reference/configuration.md. The package installs a configuration with an example of each table.

# Name of a shipped rig (swdt82, ys100, ur10), or path of a rig file relative to this file.
rig = {quoted(rig)}

# Directory of store, models and reports; /var/lib/rigcal without this line. `rigcal run` without the service puts its
# control socket there, which other commands need: --socket DIRECTORY/control.sock.
# state_directory = "/var/lib/rigcal"

# Members of this group have read-only access to the daemon.
# read_group = "rigcal-read"

# The boom's bus. rigcal sends on it only with allow_transmit = true, and sets up only the nodes in transmit_nodes.
[[can]]
name = "boom" # the `link` of the rig's channels
interface = {quoted(interface)}
channel = {quoted(channel)}
{rate}# allow_transmit = true
# transmit_nodes = [32, 33, 34]
"""
    if station is not None:
        profile, family, serial = station
        listen = f"listen_to = {quoted(family)}\n" if profile == "passive" else ""
        text += f"""
# The total station: topcon_gts8 (tracking), topcon_classic, sokkia_set, or passive, which never sends anything.
[[station]]
profile = {quoted(profile)}
{listen}
# Its port, if possible by a persistent name (/dev/rigcal-station from the udev rule), and its serial settings.
[station.serial]
path = {quoted(serial.path)}
baud = {serial.baud}
bytesize = {serial.bytesize}
parity = {quoted(serial.parity)}
stopbits = {serial.stopbits}
"""
    return (
        text
        + """
# Largest root mean square error of a calibrated model on held-out fixes: reports then state passed or failed.
# [report]
# tolerance_mm = 10.0
"""
    )


def rig_file(name: str, joints: Sequence[JointChoice], prisms: Sequence[str], heard: HeardBus | None) -> str:
    """Return a rig file with a row for each joint, whose lengths and angles must still be filled in.

    Args:
        name: of the rig.
        joints: from the base outwards.
        prisms: names of prisms on the last link.
        heard: frames received from its bus; None if the bus was not listened to.
    """
    parts = [
        f"""# A rig file: docs/how-to/rig-files.md shows how to write one, docs/reference/rig-keys.md lists all keys.
# FILL IN from the drawings: numbers of [[row]], offsets of prisms, zeros of encoders. Lengths in mm, angles in deg.
{_heard_comment(heard)}
name = {quoted(name)}
convention = "mdh_beta_after"
gravity = [0, 0, -1]      # direction in the base frame

[tolerances]              # build tolerances of these numbers, 1 sigma
length_mm = 5.0
angle_deg = 0.2
beta_deg = 0.1
prism_mm = 3.0

[station]                 # random error of a fix, from the instrument's data sheet
angle_sigma_arcsec = 5.0
distance_sigma_mm = 2.0
distance_sigma_ppm = 2.0
target_sigma_mm = 1.0
"""
    ]
    parts += [_joint(joint) for joint in joints]
    parts += [_row(number, joint) for number, joint in enumerate(joints, start=1)]
    parts += [
        f"""
[[prism]]
name = {quoted(prism)}
frame = {len(joints)}                 # number of the [[row]] whose link carries it
offset_mm = [0, 0, {100 * (place + 1)}]   # FILL IN, in that frame
"""
        for place, prism in enumerate(prisms)
    ]
    parts += [_channel(joint) for joint in joints]
    return "".join(parts)


def _heard_comment(heard: HeardBus | None) -> str:
    if heard is None:
        return ""
    shown = list(heard.identifiers.items())[:_IDENTIFIERS_SHOWN]
    told = ", ".join(f"{identifier:X}h" for identifier, _ in shown) or "nothing"
    more = f" and {len(heard.identifiers) - len(shown)} more" if len(heard.identifiers) > len(shown) else ""
    nodes = ", ".join(map(str, heard.nodes)) or "none"
    return f"# Heard on the bus: identifiers {told}{more}\n# CANopen nodes among them: {nodes}\n"


def _joint(joint: JointChoice) -> str:
    low, high = joint.limits
    sigma = 0.005 if joint.kind == "revolute" else 0.2
    return f"""
[[joint]]
name = {quoted(joint.name)}
kind = {quoted(joint.kind)}
limits = [{low:g}, {high:g}]      # {joint.unit}
sigma = {sigma}             # random error of a reading, {joint.unit}
"""


def _row(number: int, joint: JointChoice) -> str:
    constant = "theta" if joint.kind == "revolute" else "d"
    return f"""
[[row]]  # {number}: Trans(x,a) Rot(x,alpha) Trans(z,d) Rot(z,theta); FILL IN
alpha_deg = {90 if number % 2 else -90}
a_mm = {1000 if joint.kind == "revolute" else 0}
d_mm = 0
drive = {{ {constant} = {{ {joint.name} = 1.0 }} }}  # -1.0 if the joint counts in the opposite direction
"""


def _channel(joint: JointChoice) -> str:
    if joint.kind == "revolute":
        what = 'device = "cia406_encoder"\nunits_per_revolution = 65536  # object 6001h\nzero_counts = 0  # FILL IN'
    else:
        what = 'device = "cia406_linear"\nstep_nm = 100000  # object 6005h'
    return f"""
[[channel]]
name = {quoted(joint.name)}
{what}
node = {joint.node}
"""

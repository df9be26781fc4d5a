from __future__ import annotations

import pytest

from calibration.rig.description import Rig, parse_rig, shipped_rig

# What the shipped rigs do not use: fixed transforms, scaled couplings, two joints on one row, rows that branch.
ODD_RIG = """
name = "odd"
convention = "{convention}"
gravity = [0, -1, 0]
[tolerances]
length_mm = 5.0
angle_deg = 1.0
beta_deg = 1.0
prism_mm = 3.0
[[joint]]
name = "turn"
kind = "revolute"
limits = [-90, 90]
sigma = 0.01
[[joint]]
name = "lift"
kind = "revolute"
limits = [-40, 60]
sigma = 0.01
[[joint]]
name = "reach"
kind = "prismatic"
limits = [0, 1500]
sigma = 0.2
resolution = 0.1
[[joint]]
name = "feed"
kind = "prismatic"
limits = [0, 900]
sigma = 0.2
[[row]]
alpha_deg = 20
a_mm = 150
d_mm = 300
theta_deg = 10
drive = {{ theta = {{ turn = -1.0 }} }}
[[row]]
alpha_deg = 90
a_mm = 900
d_mm = -40
theta_deg = -15
drive = {{ theta = {{ lift = 1.0, turn = 0.25 }}, a = {{ reach = 1.0 }} }}
before = {{ x_mm = 10, y_mm = 20, z_mm = -30, rz_deg = 5, ry_deg = -7, rx_deg = 11 }}
[[row]]
alpha_deg = -70
a_mm = 120
d_mm = 500
theta_deg = 33
drive = {{ d = {{ feed = 0.5, reach = 0.1 }} }}
[[row]]
after = 1
alpha_deg = 30
a_mm = 700
d_mm = 60
drive = {{ theta = {{ turn = -1.0, lift = -1.0 }} }}
[[prism]]
name = "tip"
frame = 3
offset_mm = [10, 150, -20]
[[prism]]
name = "mid"
frame = 2
offset_mm = [0, 0, 250]
[[prism]]
name = "mast"
frame = 4
offset_mm = [0, 30, 200]
[[mass]]
name = "mast"
frame = 4
kg = 150
centre_mm = [-200, 0, 100]
[[mass]]
name = "head"
frame = 3
kg = 800
centre_mm = [0, 0, 100]
[[mass]]
name = "tube"
frame = 1
kg = 300
midway = true
[[mass]]
name = "rods"
frame = 3
kg = 0
centre_mm = [0, 0, 400]
payload = true
"""


@pytest.fixture(scope="session")
def swdt82() -> Rig:
    return shipped_rig("swdt82")


@pytest.fixture(scope="session")
def odd_rig_text() -> str:
    return ODD_RIG


@pytest.fixture(params=["mdh_beta_after", "mdh_beta_before", "dh"])
def odd_rig(request: pytest.FixtureRequest) -> Rig:
    return parse_rig(ODD_RIG.format(convention=request.param), "odd.toml")

"""Physics that no library of effects names: what a search for missing effects must not misname."""

from __future__ import annotations

from simulators.effects.outside.base_rocking import BaseRocking
from simulators.effects.outside.creep import Creep
from simulators.effects.outside.cross_law import CrossLaw
from simulators.effects.outside.prism_mast_bend import PrismMastBend
from simulators.effects.outside.stick_slip_rate import StickSlipRate
from simulators.effects.outside.thermal_cross import ThermalCross
from simulators.effects.outside.twist_by_reach import TwistByReach

__all__ = ["BaseRocking", "Creep", "CrossLaw", "PrismMastBend", "StickSlipRate", "ThermalCross", "TwistByReach"]

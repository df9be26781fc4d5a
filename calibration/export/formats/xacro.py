"""model.xacro: as model.urdf, with a prefix of all names that the caller gives."""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

from calibration.export.formats.urdf import urdf_elements, xml_comment
from calibration.export.model_export import kinematics_format
from calibration.kinematics.chain import Chain
from calibration.observations import Floats


def xacro_text(chain: Chain, x: Floats, remarks: Sequence[str]) -> str:
    """Return a rig with parameters `x` (p,) as a xacro document: a macro with a prefix for all names, used once."""
    macro = "rigcal_rig"
    body = "\n".join(f"    {line}" for line in urdf_elements(chain, x, "${prefix}"))
    return (
        f'<?xml version="1.0"?>\n{xml_comment(remarks)}'
        f'<robot name={quoteattr(chain.rig.name)} xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
        f'  <xacro:macro name="{macro}" params="prefix">\n{body}\n  </xacro:macro>\n'
        f'  <xacro:arg name="prefix" default=""/>\n  <xacro:{macro} prefix="$(arg prefix)"/>\n</robot>\n'
    )


FORMAT = kinematics_format("xacro", "model.xacro", "the same with a prefix that the caller gives", xacro_text)

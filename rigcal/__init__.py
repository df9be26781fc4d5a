"""The public interface of rigcal, for programs and notebooks that calibrate a machine.

    import rigcal

    rig = rigcal.Rig.read("ur10")
    fixes = rigcal.Observations.from_csv("fixes.csv", rig)
    model = rigcal.calibrate(rig, fixes)
    model.predict(fixes).position_mm

`docs/how-to/notebook.md` is a worked example. The names exported here follow Semantic Versioning; everything else in
the packages `calibration`, `daemon`, `drivers` and `simulators` may change without notice.
"""

from calibration.design.planning import PosePlan
from calibration.effects.fitted import FittedEffect
from calibration.errors import CalibrationError, DataError, ModelError, RigError, UnsafeError
from calibration.evaluation.evaluation import Evaluation
from calibration.gap.result import GapResult
from calibration.model.inverse import Inverse
from calibration.model.model import ParameterEstimate
from calibration.model.prediction import Prediction
from calibration.observations import Observations
from calibration.rig.description import Rig
from daemon.store.errors import StoreError
from daemon.version import VERSION
from rigcal.calibration_api import Model, calibrate, find_gap, plan
from rigcal.store_api import Store, open_store

__version__ = VERSION

__all__ = [
    "CalibrationError",
    "DataError",
    "Evaluation",
    "FittedEffect",
    "GapResult",
    "Inverse",
    "Model",
    "ModelError",
    "Observations",
    "ParameterEstimate",
    "PosePlan",
    "Prediction",
    "Rig",
    "RigError",
    "Store",
    "StoreError",
    "UnsafeError",
    "__version__",
    "calibrate",
    "find_gap",
    "open_store",
    "plan",
]

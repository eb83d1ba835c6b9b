"""The stages of judging, in their order: one file each, and one line here."""

from qd.faults.stages.base import Stage
from qd.faults.stages.fresh import Fresh
from qd.faults.stages.others import Others
from qd.faults.stages.resolved import Resolved
from qd.faults.stages.varied import Varied

STAGES: dict[str, Stage] = {stage.name: stage for stage in (Fresh(), Resolved(), Others(), Varied())}

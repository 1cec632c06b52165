"""Predicted against measured return of policies and controls: on a simulator, then in closed loop on the culture."""

from animat.reality_gap.calibration import Calibration
from animat.reality_gap.row import Row
from animat.reality_gap.running import check_policies, run_policies
from animat.reality_gap.table import RealityGap

__all__ = ["Calibration", "RealityGap", "Row", "check_policies", "run_policies"]

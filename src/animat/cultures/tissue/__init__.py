"""The tissue of the virtual culture: a spiking network that can be stimulated and tires, in compiled steps."""

from animat.cultures.tissue.coupling import Pulse
from animat.cultures.tissue.parameters import ShortTerm, TissueParameters
from animat.cultures.tissue.snapshot import Snapshot
from animat.cultures.tissue.tissue import Spikes, Tissue

__all__ = ["Pulse", "ShortTerm", "Snapshot", "Spikes", "Tissue", "TissueParameters"]

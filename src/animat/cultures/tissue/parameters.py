"""Every number of the virtual tissue, with its unit and where it comes from."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from animat.errors import InvalidArgument
from animat.records import FromZero, Number, Positive, Share, Whole, record

REVISION = 6
"""Revision of the tissue's numerics. Raise it by one when the same seed, parameters and pulses give different spikes,
whatever the reason (an equation, an order of operations, a table, a draw): recordings, states and studies of another
revision are then refused instead of being continued as if they were of this tissue."""


@record
class ShortTerm:
    """Short-term plasticity of one kind of synapse (Tsodyks, Pawelzik & Markram 1998, doi 10.1162/089976698300017502).

    A spike releases u x; then x falls by it and u rises by U (1 - u); between spikes x recovers to 1, u to U.

    Attributes:
        use: U, the resting release probability.
        recovery_ms: time constant of x.
        facilitation_ms: time constant of u; 0 for a synapse that does not facilitate.
    """

    use: Annotated[Share, Field(gt=0)]
    recovery_ms: Positive
    facilitation_ms: FromZero = 0.0


@record
class TissueParameters:
    """The parameters of a virtual tissue; conductances are in units of the leak.

    Marks: [L] from the literature, [C] calibrated to reproduce the figures of `docs/evidence/virtual-culture.md`.

    Raises:
        InvalidArgument: for a number that is not finite or outside its range.
    """

    # Size and place.
    neurons: Annotated[Whole, Field(ge=10)] = 1200
    """[C] Number of neurons, spread uniformly over the array."""
    excitatory_share: Share = 0.8
    """[L] Share of excitatory neurons."""
    width_um: Positive = 3850.0
    height_um: Positive = 2100.0
    """The array's sides."""
    step_ms: Positive = 0.2
    """The time step."""

    # Membrane.
    membrane_e_ms: Positive = 20.0
    membrane_i_ms: Positive = 10.0
    """[L] Membrane time constants."""
    leak_mv: Number = -70.0
    threshold_mv: Number = -50.0
    """[L] Leak reversal and resting threshold."""
    reset_mv: Number = -60.0
    """[C] Potential after a spike."""
    potassium_mv: Number = -80.0
    gaba_mv: Number = -70.0
    """[L] Reversal potentials of the after-hyperpolarisation and of inhibition; excitation reverses at 0."""
    refractory_e_ms: Positive = 3.0
    refractory_i_ms: Positive = 2.0
    """[L] Absolute refractory periods."""
    hyperpolarisation: Number = 0.0023
    """[C] Added to the potassium conductance by each spike."""
    hyperpolarisation_ms: Positive = 25000.0
    """[L] Its time constant: after a train the sodium pump hyperpolarises for about 20 s (Gulledge et al. 2013,
    doi 10.1523/JNEUROSCI.0220-13.2013)."""
    adaptation_mv: Number = 0.27
    adaptation_ms: Positive = 126.0
    """[C] Added to the threshold by each spike, and its time constant."""

    # Synapses.
    ampa_ms: Positive = 3.0
    nmda_ms: Positive = 110.0
    gaba_ms: Positive = 10.0
    """[L] Decay of the synaptic conductances."""
    nmda_ratio: Number = 0.82
    """[L] NMDA conductance added for each unit of AMPA; 0 blocks NMDA."""
    nmda_saturation: Number = 2.0
    """[C] The NMDA conductance at which arrivals add no more."""
    e_to_e: ShortTerm = ShortTerm(0.12, 1090.0, 220.0)
    e_to_i: ShortTerm = ShortTerm(0.12, 200.0, 140.0)
    i_to_any: ShortTerm = ShortTerm(0.137, 665.0)
    """[C] within [L]: short-term plasticity."""
    weight_ee: Number = 0.56
    weight_ei: Number = 0.9483
    weight_ie: Number = 0.302
    weight_ii: Number = 0.94
    weight_sigma: Number = 0.5
    """[C] Mean weights, from the first letter to the second, and the sigma of their log-normal spread."""
    in_degree_e: Whole = 52
    in_degree_i: Whole = 30
    """[C] Synapses on each neuron, from excitatory and from inhibitory neurons."""
    reach_um: Positive = 220.0
    """[C] A connection's probability falls as exp(-distance / reach)."""
    long_range_share: Share = 0.1
    """[C] Share of connections regardless of distance."""
    out_degree_sigma: Number = 0.4
    """[C] Sigma of the log-normal spread of out-degrees."""
    communities: Annotated[Whole, Field(ge=1)] = 2
    """[C] Number of communities, each of the neurons nearest to one centre."""
    between_share: Annotated[Share, Field(gt=0)] = 0.035
    """[C] Likelihood of a connection between communities, relative to one within at the same distance."""
    delay_ms: FromZero = 0.8
    """Delay of a synapse without distance."""
    conduction_um_per_ms: Positive = 500.0
    """[L] Speed of axons."""

    # Drive.
    drive_mv: Number = 9.9
    drive_spread_mv: Number = 1.8
    """[C] Mean of the constant drive over neurons, and its standard deviation."""
    community_drive_mv: Number = 0.1
    """[C] Standard deviation of the additional drive of each community's neurons: some lead."""
    noise_mv: Number = 7.5
    noise_ms: Positive = 5.0
    """[C] Standard deviation and time constant of the Ornstein-Uhlenbeck drive."""
    shared_noise_mv: Number = 0.6
    """[C] Standard deviation of the slow Ornstein-Uhlenbeck drive that all neurons of a community share."""
    shared_noise_ms: Positive = 575.0
    """[C] Its time constant (astrocytes excite neighbours together for about as long: Fellin et al. 2004,
    doi 10.1016/j.neuron.2004.08.011)."""

    # Stimulation.
    kick_mv: Number = 68.0
    kick_sigma: Number = 0.35
    """[C] Median depolarisation of a neuron on the electrode by a full pulse; sigma of its log-normal spread."""
    kick_reach_um: Positive = 40.0
    """[C] The kick falls as 1 / (1 + (distance / reach)^2)."""
    axons_per_electrode: Number = 14.5
    axon_reach_um: Positive = 500.0
    """[C] Expected number of axons that an electrode drives; their probability falls as exp(-distance / reach)."""
    axon_reliability: Share = 0.8
    """[L] Probability that a pulse drives an axon in its reach."""
    axon_latency_ms: FromZero = 0.5
    axon_latency_spread_ms: FromZero = 1.0
    """[C] Latency: this, conduction, and a share of the spread specific to each neuron."""
    axon_jitter_ms: FromZero = 0.16
    """[L] Standard deviation of the latency from pulse to pulse."""
    availability_loss: Share = 0.033
    """[C] Share of a neuron's availability lost with each spike."""
    availability_s: Positive = 2.8
    """[C] Time constant of its recovery (Goldental et al. 2014: failures above a critical frequency)."""
    availability_needed_low: Number = 0.30
    availability_needed_high: Number = 0.55
    """[C] A pulse drives a neuron only while its availability exceeds a threshold drawn between these."""

    # What changes over minutes and hours.
    scaling_loss: Share = 3e-5
    """[C] Share of all excitatory weights lost with a spike of each excitatory neuron (homeostatic scaling)."""
    scaling_min: Positive = 120.0
    """[L] Time constant of its recovery (Turrigiano 2008: hours)."""
    scaling_at_hz: FromZero = 0.62
    """[C] Mean excitatory rate that scaling maintains, at which loss and recovery balance at full weights."""
    load_gain: Share = 0.08
    """[C] Share of the gap between the axon's load and 1 that each spike started in the axon by a stimulus fills."""
    load_min: Positive = 30.0
    """[C] Time constant with which the load decays."""
    conduction_min: Positive = 90.0
    """[C] Time constant with which the share of such spikes that fail follows it (Grubb & Burrone 2010: hours)."""
    output_loss: Share = 1.0
    """[C] Share of an excitatory axon's conduction failures that also reduces its output; 1: all of it."""
    drift_share: Share = 0.03
    drift_min: Positive = 30.0
    """[C] Standard deviation and time constant of the slow drift of all excitatory weights."""

    def __post_init__(self) -> None:
        if self.load_min == self.conduction_min:
            raise InvalidArgument(f"load_min, conduction_min: expected different values, got {self.load_min} twice")
        n_inhibitory = self.neurons - self.n_excitatory
        for degree, available in ((self.in_degree_e, self.n_excitatory), (self.in_degree_i, n_inhibitory)):
            if not 0 <= degree < available:
                expected = f"expected fewer synapses than the {available} neurons of that type"
                raise InvalidArgument(f"in_degree_e, in_degree_i: {expected}, got {degree}")

    @property
    def scaling_rest(self) -> float:
        """Value to which the scaling recovers; recovery then balances the loss at `scaling_at_hz` and full weights."""
        return 1 + self.scaling_loss * self.scaling_at_hz * self.scaling_min * 60

    @property
    def n_excitatory(self) -> int:
        """Number of excitatory neurons; they come first in every array."""
        return round(self.neurons * self.excitatory_share)

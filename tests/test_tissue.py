"""The virtual tissue: one function of seed and pulses however time is cut, and its equations against closed forms."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.cultures.tissue import Pulse, ShortTerm, Spikes, Tissue, TissueParameters, kernel
from animat.cultures.tissue.coupling import Kicks
from animat.cultures.tissue.kernel import AXONAL_KICK_MV
from animat.cultures.tissue.network import _communities, grow
from animat.cultures.tissue.preparation import block_polynomial, nmda_block, prepare_wiring
from animat.cultures.tissue.tissue import Drift
from animat.errors import InvalidArgument, Mismatch

SMALL = TissueParameters(neurons=200, width_um=1500.0, height_um=1000.0, in_degree_e=40, in_degree_i=15)
QUIET = {"drive_spread_mv": 0.0, "community_drive_mv": 0.0, "noise_mv": 0.0, "shared_noise_mv": 0.0}
SILENT = dataclasses.replace(SMALL, drive_mv=0.0, **QUIET)
"""Neurons that never spike by themselves."""


def pulses_over_a_second() -> list[Pulse]:
    rng = np.random.default_rng(5)
    return [
        Pulse(time_s, rng.uniform(0, 1500, 3), rng.uniform(0, 1000, 3), strength)
        for time_s, strength in [(0.0, 1.0), (0.0125, 0.5), (0.2499, 1.0), (0.25, 2.0), (0.9999, 1.0), (0.99999, 1.0)]
    ]


def in_pieces(tissue: Tissue, edges_s: list[float], pulses: list[Pulse]) -> Spikes:
    parts = []
    for start_s, end_s in pairwise(edges_s):
        due = [pulse for pulse in pulses if start_s <= pulse.time_s < end_s]
        parts.append(tissue.advance(end_s - start_s, due))
    return Spikes(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def assert_same_spikes(one: Spikes, other: Spikes) -> None:
    np.testing.assert_array_equal(one.time_s, other.time_s)
    np.testing.assert_array_equal(one.neuron, other.neuron)


@pytest.mark.oracle
def test_a_second_in_eighty_pieces_is_the_same_bit_for_bit() -> None:
    whole, cut = Tissue(7), Tissue(7)
    x_um, y_um = np.array([500.0, 1500.0, 2500.0]), np.array([400.0, 1200.0, 1800.0])
    pulses = [Pulse(time_s, x_um, y_um) for time_s in (0.1, 0.3, 0.30005, 0.7)]
    expected = whole.advance(1.0, pulses)
    assert len(expected.time_s) > 500
    assert_same_spikes(in_pieces(cut, [i / 80 for i in range(81)], pulses), expected)
    assert cut.now_s == whole.now_s == 1.0
    # Not only the spikes so far: nothing that matters later was lost.
    assert_same_spikes(cut.advance(0.5), whole.advance(0.5))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 999_999), max_size=12, unique=True))
def test_spikes_do_not_depend_on_how_time_is_cut(cuts_us: list[int]) -> None:
    edges_s = [0.0, *(cut / 1e6 for cut in sorted(cuts_us)), 1.0]
    expected = Tissue(3, SMALL).advance(1.0, pulses_over_a_second())
    assert_same_spikes(in_pieces(Tissue(3, SMALL), edges_s, pulses_over_a_second()), expected)


def test_the_cut_does_not_matter_across_a_mark_of_the_drift() -> None:
    whole, cut = Tissue(3, SMALL), Tissue(3, SMALL)
    for tissue in (whole, cut):
        tissue.rest(9.5)
    expected = whole.advance(1.0)
    assert len(expected.time_s) > 50
    assert_same_spikes(Spikes(*map(np.concatenate, zip(cut.advance(0.49), cut.advance(0.51), strict=True))), expected)


def test_one_seed_one_culture() -> None:
    one, again, other = (Tissue(seed, SMALL).advance(1.0, pulses_over_a_second()) for seed in (1, 1, 2))
    assert_same_spikes(one, again)
    assert len(one.time_s) != len(other.time_s) or not np.array_equal(one.neuron, other.neuron)


def test_many_spikes_in_one_call_are_all_returned() -> None:
    wild = dataclasses.replace(SMALL, drive_mv=100.0)
    whole, cut = Tissue(1, wild), Tissue(1, wild)
    expected = whole.advance(2.0)
    assert len(expected.time_s) > 40_000
    assert_same_spikes(in_pieces(cut, [i / 10 for i in range(21)], []), expected)


def test_a_snapshot_is_come_back_to() -> None:
    tissue = Tissue(1, SMALL)
    tissue.advance(0.3, [Pulse(0.2999, np.array([700.0]), np.array([500.0]))])  # its axonal spikes are under way
    snapshot = tissue.snapshot()
    expected = tissue.advance(0.5)
    tissue.restore(snapshot)
    assert tissue.now_s == 0.3
    assert_same_spikes(tissue.advance(0.5), expected)
    with pytest.raises(Mismatch, match="snapshot"):
        Tissue(2, SMALL).restore(snapshot)


def test_a_copy_is_a_tissue_of_its_own() -> None:
    tissue = Tissue(1, SMALL)
    tissue.advance(0.3, [Pulse(0.2999, np.array([700.0]), np.array([500.0]))])
    other = copy.deepcopy(tissue)
    expected = tissue.advance(0.5)
    assert_same_spikes(other.advance(0.5), expected)


def test_spikes_are_in_order_and_on_the_clock() -> None:
    tissue = Tissue(1, SMALL)
    tissue.rest(10.0)
    spikes = tissue.advance(2.0)
    assert np.all(np.diff(spikes.time_s) >= 0)
    assert spikes.time_s[0] >= 10.0
    assert spikes.time_s[-1] < 12.0
    assert tissue.now_s == 12.0


# --- the network


def test_the_network_is_as_described() -> None:
    parameters = TissueParameters()
    network = grow(1, parameters)
    is_e = network.is_excitatory
    assert is_e.sum() == 960
    assert np.all(is_e[:960])
    source = np.repeat(np.arange(1200), np.diff(network.start))
    from_e = np.bincount(network.target[is_e[source]], minlength=1200)
    from_i = np.bincount(network.target[~is_e[source]], minlength=1200)
    assert np.all(from_e == parameters.in_degree_e)
    assert np.all(from_i == parameters.in_degree_i)
    assert not np.any(source == network.target)
    pairs = source.astype(np.int64) * 1200 + network.target
    assert len(np.unique(pairs)) == len(pairs)
    distance_um = np.hypot(
        network.x_um[source] - network.x_um[network.target], network.y_um[source] - network.y_um[network.target]
    )
    delay_ms = parameters.delay_ms + distance_um / parameters.conduction_um_per_ms
    assert np.max(np.abs(network.delay_steps * parameters.step_ms - delay_ms)) <= parameters.step_ms / 2 + 1e-9
    for from_kind, to_kind, mean in (
        (True, True, parameters.weight_ee),
        (True, False, parameters.weight_ei),
        (False, True, parameters.weight_ie),
        (False, False, parameters.weight_ii),
    ):
        weights = network.weight[(is_e[source] == from_kind) & (is_e[network.target] == to_kind)]
        assert weights.mean() == pytest.approx(mean, rel=5 * 0.54 / np.sqrt(len(weights)))
        assert np.log(weights).std() == pytest.approx(parameters.weight_sigma, rel=0.05)


# --- the equations, against closed forms


def test_the_membrane_charges_as_in_closed_form() -> None:
    tissue = Tissue(1, dataclasses.replace(SILENT, drive_mv=12.0))
    state = tissue._state
    state.v_mv[:] = -70.0
    tissue.advance(0.010)
    is_e = tissue.is_excitatory
    for group, tau_ms in ((is_e, 20.0), (~is_e, 10.0)):
        np.testing.assert_allclose(state.v_mv[group], -70 + 12 * (1 - np.exp(-10 / tau_ms)), atol=1e-3)


def test_a_held_conductance_moves_the_membrane_as_in_closed_form() -> None:
    tissue = Tissue(1, dataclasses.replace(SILENT, gaba_ms=1e9, hyperpolarisation_ms=1e9))
    state = tissue._state
    state.v_mv[:], state.gaba[:], state.potassium[:] = -55.0, 3.0, 1.5
    tissue.advance(0.004)
    resting = (-70 - 3 * 70 - 1.5 * 80) / 5.5
    tau_ms = np.where(tissue.is_excitatory, 20.0, 10.0) / 5.5
    np.testing.assert_allclose(state.v_mv, resting + (-55 - resting) * np.exp(-4 / tau_ms), rtol=1e-4)


def test_conductances_and_adaptation_decay_as_in_closed_form() -> None:
    tissue = Tissue(1, SILENT)
    state, parameters = tissue._state, tissue.parameters
    pairs = (
        (state.ampa, parameters.ampa_ms),
        (state.nmda, parameters.nmda_ms),
        (state.gaba, parameters.gaba_ms),
        (state.potassium, parameters.hyperpolarisation_ms),
        (state.adaptation_mv, parameters.adaptation_ms),
    )
    state.v_mv[:] = -70.0
    for values, _ in pairs:
        values[:] = 0.01
    tissue.advance(0.050)
    for values, tau_ms in pairs:
        np.testing.assert_allclose(values, 0.01 * np.exp(-50 / tau_ms), rtol=1e-4)


def test_silence_does_not_end_in_subnormal_numbers() -> None:
    tissue = Tissue(1, SILENT)
    tissue.advance(5.0)
    for name in ("ampa", "nmda", "gaba", "potassium", "adaptation_mv"):
        assert np.all(getattr(tissue._state, name) > np.finfo(np.float32).tiny)


def test_the_nmda_block_is_the_published_one() -> None:
    v_mv = np.linspace(-85, -35, 500)
    polynomial = np.polynomial.Polynomial(np.array(block_polynomial(), dtype=float))
    np.testing.assert_allclose(polynomial((v_mv + 60) / 25), nmda_block(v_mv), atol=1e-7)
    assert nmda_block(np.array([0.0]))[0] == pytest.approx(3.57 / 4.57)


def test_the_noise_is_an_ornstein_uhlenbeck_process() -> None:
    tissue = Tissue(1, dataclasses.replace(SILENT, noise_mv=2.0, noise_ms=5.0))
    tissue.advance(0.05)
    values = []
    for _ in range(4000):
        tissue.advance(0.001)
        values.append(tissue._state.drive_mv.copy())
    drive_mv = np.array(values, dtype=float)
    assert drive_mv.mean() == pytest.approx(0.0, abs=0.02)
    assert drive_mv.std() == pytest.approx(2.0, rel=0.01)
    standard = drive_mv / drive_mv.std()
    # A sum of four uniform numbers has an excess of -0.3; of independent moves 1 ms apart this is left.
    assert np.mean(standard**4) == pytest.approx(3.0 - 0.3 * np.tanh(1 / 5.0), abs=0.03)
    assert np.mean(standard**3) == pytest.approx(0.0, abs=0.03)
    for lag_ms in (1, 5, 10):
        correlation = np.mean(standard[lag_ms:] * standard[:-lag_ms])
        assert correlation == pytest.approx(np.exp(-lag_ms / 5.0), abs=0.01)
    between_neurons = np.corrcoef(drive_mv.T)
    off_diagonal = between_neurons[~np.eye(len(between_neurons), dtype=bool)]
    # 4,000 samples 1 ms apart, correlated over 5 ms, are worth about 400.
    assert np.abs(off_diagonal).max() < 6 / np.sqrt(400)


def test_no_neuron_spikes_within_its_refractory_period() -> None:
    tissue = Tissue(1, dataclasses.replace(SMALL, drive_mv=3000.0, adaptation_mv=0.0, hyperpolarisation=0.0))
    spikes = tissue.advance(0.5)
    step = np.rint(spikes.time_s / 0.0002).astype(int)
    order = np.lexsort((step, spikes.neuron))
    step, neuron = step[order], spikes.neuron[order]
    interval, same = np.diff(step), neuron[1:] == neuron[:-1]
    excitatory = tissue.is_excitatory[neuron[1:]]
    assert interval[same & excitatory].min() == 15  # 3 ms
    assert interval[same & ~excitatory].min() == 10  # 2 ms


def test_a_train_releases_as_tsodyks_and_markram_have_it() -> None:
    kind = ShortTerm(0.2, 500.0, 150.0)
    parameters = dataclasses.replace(
        SILENT, e_to_e=kind, e_to_i=kind, weight_sigma=0.0, scaling_loss=0.0, drift_share=0.0
    )
    tissue = Tissue(1, parameters)
    neuron, interval_s = 0, 0.05
    target = tissue._network.target[tissue._network.start[neuron]]
    weight = tissue._network.weight[tissue._network.start[neuron]]
    u, x = 0.2, 1.0
    for _ in range(8):
        tissue._state.v_mv[neuron] = 0.0  # a spike at the next step
        before = tissue._state.arriving_ampa[:, target].sum() + 0.0
        spikes = tissue.advance(0.0002)
        assert neuron in spikes.neuron
        sent = tissue._state.arriving_ampa[:, target].sum() - before
        assert sent == pytest.approx(weight * u * x, rel=1e-5)
        x, u = x - u * x, u + 0.2 * (1 - u)
        tissue.advance(interval_s - 0.0002)
        x = 1 - (1 - x) * np.exp(-interval_s / 0.5)
        u = 0.2 + (u - 0.2) * np.exp(-interval_s / 0.15)


# --- the noise that a community shares


def test_the_shared_noise_has_the_spread_and_the_correlation_that_are_said() -> None:
    parameters = dataclasses.replace(SILENT, shared_noise_mv=0.5, shared_noise_ms=40.0, communities=20)
    tissue = Tissue(1, parameters)
    tissue.advance(1.0)
    shared_mv = []
    for _ in range(400):
        tissue.advance(0.020)
        shared_mv.append(tissue._state.shared_mv.copy())
    seen_mv = np.array(shared_mv)
    # 8,000 numbers, half a time constant apart: some 2,000 of them independent.
    assert seen_mv.std() == pytest.approx(0.5, rel=0.08)
    assert abs(seen_mv.mean()) < 0.05
    assert np.mean(seen_mv[1:] * seen_mv[:-1]) / np.mean(seen_mv**2) == pytest.approx(np.exp(-0.5), abs=0.06)
    across = np.corrcoef(seen_mv.T)[np.triu_indices(20, 1)]
    assert abs(across.mean()) < 0.05


def test_all_neurons_of_a_community_get_the_same_of_it() -> None:
    tissue = Tissue(1, dataclasses.replace(SILENT, shared_noise_mv=0.5, communities=3))
    community = grow(1, tissue.parameters).community
    tissue.advance(0.5)
    drive_mv, shared_mv = tissue._state.drive_mv, tissue._state.shared_mv
    assert len(np.unique(shared_mv)) == 3
    for number in range(3):
        of_it = drive_mv[community == number]
        assert np.ptp(of_it) < 1e-5
        # The drive follows with a time constant of 5 ms what moves by 0.07 mV in 5 ms.
        assert of_it[0] == pytest.approx(shared_mv[number], abs=0.3)


# --- rest, and what changes over minutes and hours


def later(tissue: Tissue, duration_s: float) -> None:
    """Move the clock and nothing else, as if nothing had spiked: what recovers between spikes is looked at then."""
    snapshot = tissue.snapshot()
    now_ns = snapshot.now_ns + round(duration_s * 1e9)
    tissue.restore(dataclasses.replace(snapshot, now_ns=now_ns, step=now_ns // 200_000))
    tissue._state.refractory[:] = 0


def spike(tissue: Tissue, neuron: int) -> None:
    tissue._state.v_mv[neuron] = 0.0
    assert neuron in tissue.advance(0.0002).neuron


@pytest.mark.oracle
def test_resting_is_advancing_without_being_watched() -> None:
    watched, rested = Tissue(3, SMALL), Tissue(3, SMALL)
    pulse = Pulse(0.2999, np.array([700.0]), np.array([500.0]))  # its axonal spikes are under way
    for tissue in (watched, rested):
        tissue.advance(0.3, [pulse])
    watched.advance(125.0)
    rested.rest(125.0)
    assert_same_spikes(rested.advance(1.0), watched.advance(1.0))
    assert rested.now_s == watched.now_s == pytest.approx(126.3)


def test_a_clock_may_be_longer_than_32_bits_of_steps() -> None:
    tissue = Tissue(1, SILENT)
    tissue.advance(0.1)
    later(tissue, 7 * 86_400.0)
    assert tissue.now_s == pytest.approx(604_800.1)
    spike(tissue, 0)


def test_the_drift_is_one_function_of_time_with_the_spread_said() -> None:
    parameters = TissueParameters()
    late_first, in_order = Drift(1, parameters), Drift(1, parameters)
    late = late_first.gain(840)
    assert [in_order.gain(mark) for mark in (0, 3, 840)] == [1.0, late_first.gain(3), late]
    drift = np.array([Drift(seed, parameters).gain(840) for seed in range(200)]) - 1
    assert drift.mean() == pytest.approx(0.0, abs=4 * 0.03 / np.sqrt(200))
    assert drift.std() == pytest.approx(0.03, rel=0.2)


def test_excitation_is_scaled_down_by_spikes_and_up_by_silence() -> None:
    tissue = Tissue(1, SILENT)
    p, n_e = tissue.parameters, tissue.parameters.n_excitatory
    at_rest = 1 + p.scaling_loss * p.scaling_at_hz * 60 * p.scaling_min
    scaling, last_s = 1.0, 0.0
    for number in range(100):
        spike(tissue, number % n_e)
        now_s = tissue.now_s - 0.0002
        scaling = at_rest - (at_rest - scaling) * np.exp((last_s - now_s) / (60 * p.scaling_min))
        scaling *= 1 - p.scaling_loss / n_e
        last_s = now_s
        tissue.advance(0.01)
    assert tissue._state.scaling[0] == pytest.approx(scaling, rel=1e-9)
    spike(tissue, n_e)  # an inhibitory neuron's spike scales nothing
    assert tissue._state.scaling[0] == pytest.approx(scaling, rel=1e-9)
    later(tissue, 20 * 3600.0)
    spike(tissue, 0)
    assert tissue._state.scaling[0] == pytest.approx(at_rest, rel=1e-4)


def test_what_is_sent_is_in_proportion_to_the_scaling() -> None:
    sent = []
    for scaling in (1.0, 0.5):
        tissue = Tissue(1, dataclasses.replace(SILENT, drift_share=0.0))
        tissue._state.scaling[0] = scaling
        spike(tissue, 0)
        sent.append(tissue._state.arriving_ampa.sum())
    assert sent[1] == pytest.approx(0.5 * sent[0], rel=1e-3)


def kicked(tissue: Tissue, neuron: int) -> bool:
    """Whether a spike that starts in the neuron's axon comes."""
    tissue._kicks = Kicks(np.array([tissue._step]), np.array([neuron]), np.array([AXONAL_KICK_MV], np.float32))
    return neuron in tissue.advance(0.0002).neuron


def test_the_conduction_of_a_stimulated_axon_follows_its_load() -> None:
    # Against Euler steps of 0.1 s of d(load)/dt = -load / T and d(missing)/dt = (load - missing) / T'.
    p = dataclasses.replace(SILENT, load_gain=0.2, load_min=3.0, conduction_min=8.0)
    tissue, load, missing = Tissue(1, p), 0.0, 0.0
    came, expected = 0, 0.0
    for _ in range(300):
        later(tissue, 20.0)
        for _ in range(200):
            load, missing = load - 0.1 * load / 180, missing + 0.1 * (load - missing) / 480
        expected += 1 - missing
        if kicked(tissue, 0):
            came += 1
            load += 0.2 * (1 - load)
            assert tissue._state.load[0] == pytest.approx(load, abs=2e-3)
            assert tissue._state.missing[0] == pytest.approx(missing, abs=2e-3)
    assert missing > 0.4
    assert came == pytest.approx(expected, abs=4 * np.sqrt(300 * 0.25))
    assert np.all(tissue._state.load[1:] == 0.0)


@pytest.mark.parametrize("output_loss", [0.0, 0.5, 1.0])
def test_a_neuron_sends_as_much_less_as_its_axon_fails_to_conduct(output_loss: float) -> None:
    parameters = dataclasses.replace(SILENT, drift_share=0.0, output_loss=output_loss)
    inhibitory = parameters.n_excitatory
    sent = []
    for missing in (0.0, 0.4):
        tissue = Tissue(1, parameters)
        # Driven just now, by next to nothing: what is missing has had no time to change.
        tissue._state.missing[:], tissue._state.load[:], tissue._state.last_driven[:] = missing, 1e-9, tissue._step
        spike(tissue, 0)
        spike(tissue, inhibitory)
        sent.append((tissue._state.arriving_ampa.sum(), tissue._state.arriving_gaba.sum()))
    (excited, inhibited), (excited_less, inhibited_as_much) = sent
    assert excited_less == pytest.approx((1 - 0.4 * output_loss) * excited, rel=1e-3)
    assert inhibited_as_much == inhibited > 0


def test_kicks_near_the_electrode_need_no_axon() -> None:
    tissue = Tissue(1, SILENT)
    tissue._state.missing[:] = 1.0
    tissue._kicks = Kicks(np.array([0, 0]), np.array([0, 1]), np.array([AXONAL_KICK_MV, 100.0], np.float32))
    assert tissue.advance(0.0002).neuron.tolist() == [1]


def test_communities_are_patches_that_are_coupled_weakly() -> None:
    parameters = TissueParameters()
    shares = []
    for between_share in (parameters.between_share, 1.0):
        network = grow(1, dataclasses.replace(parameters, between_share=between_share))
        community, _ = _communities(np.random.default_rng([1, 9]), network.x_um, network.y_um, parameters)
        size = np.bincount(community, minlength=parameters.communities)
        assert len(size) == parameters.communities
        assert size.min() > 0.15 * parameters.neurons
        source = np.repeat(np.arange(len(network)), np.diff(network.start))
        shares.append(np.mean(community[source] != community[network.target]))
        # Whoever it comes from, every neuron has as many synapses as is said.
        assert np.all(np.bincount(network.target) == parameters.in_degree_e + parameters.in_degree_i)
    assert 0.002 < shares[0] < 0.3 * shares[1]


# --- stimulation


def electrodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(0, 3850, count), rng.uniform(0, 2100, count)


def test_an_electrode_meets_as_many_axons_as_it_should() -> None:
    tissue = Tissue(1)
    coupling, parameters = tissue._coupling, tissue.parameters
    x_um, y_um = electrodes(400)
    reaches = [coupling.reach(x_um[i : i + 1], y_um[i : i + 1]) for i in range(400)]
    axons = np.array([np.sum(reach.axon_rank < 1) for reach in reaches])
    assert axons.mean() == pytest.approx(parameters.axons_per_electrode, abs=4 * axons.std() / 20)
    for i, reach in enumerate(reaches):
        distance_um = np.hypot(tissue.x_um[reach.axons] - x_um[i], tissue.y_um[reach.axons] - y_um[i])
        own_ms = reach.axon_latency_ms - parameters.axon_latency_ms - distance_um / parameters.conduction_um_per_ms
        # Positions are distinguished to 0.1 um.
        assert np.all((own_ms > -1e-3) & (own_ms < parameters.axon_latency_spread_ms + 1e-3))


def test_axonal_spikes_are_reliable_and_precise_as_said() -> None:
    tissue = Tissue(1)
    x_um, y_um = electrodes(1)
    reach = tissue._coupling.reach(x_um, y_um)
    full = reach.axon_rank < 1
    arrivals: dict[int, list[int]] = {int(neuron): [] for neuron in reach.axons[full]}
    for step in range(0, 200_000, 100):
        kicks = tissue._coupling.kicks(Pulse(0.0, x_um, y_um), step)
        axonal = kicks.mv == AXONAL_KICK_MV
        for neuron, arrival in zip(kicks.neuron[axonal], kicks.step[axonal], strict=True):
            arrivals[int(neuron)].append(int(arrival) - step)
    passed = np.array([len(each) for each in arrivals.values()])
    assert passed.mean() / 2000 == pytest.approx(0.8, abs=4 * 0.4 / np.sqrt(2000 * len(passed)))
    for neuron, each in arrivals.items():
        latency_ms = reach.axon_latency_ms[reach.axons == neuron][0]
        assert np.mean(each) * 0.2 == pytest.approx(latency_ms, abs=0.03)
        # Rounding to steps of 0.2 ms adds a twelfth of their square.
        assert np.std(each) * 0.2 == pytest.approx(np.sqrt(0.16**2 + 0.2**2 / 12), rel=0.1)


def test_a_pulse_makes_neurons_near_its_electrode_spike_at_once() -> None:
    tissue = Tissue(1, dataclasses.replace(SILENT, axons_per_electrode=1e-9))
    tissue.advance(0.2)  # settled at -70 mV, 20 mV below threshold
    x_um, y_um = np.array([750.0]), np.array([500.0])
    reach = tissue._coupling.reach(x_um, y_um)
    spikes = tissue.advance(0.001, [Pulse(tissue.now_s, x_um, y_um)])
    expected = set(reach.near[reach.kick_mv > 21].tolist())
    assert len(expected) >= 2
    assert expected <= set(spikes.neuron.tolist()) <= set(reach.near[reach.kick_mv > 20].tolist())
    assert np.all(spikes.time_s == 0.2)


def test_a_neuron_without_availability_lets_no_pulse_pass() -> None:
    parameters = SILENT
    x_um, y_um = np.array([750.0]), np.array([500.0])
    needed = prepare_wiring(1, parameters, grow(1, parameters)).needed
    assert needed.min() > parameters.availability_needed_low
    assert needed.max() < parameters.availability_needed_high
    for available, passes in ((parameters.availability_needed_low, False), (0.9, True)):
        tissue = Tissue(1, parameters)
        tissue.advance(0.2)
        tissue._state.available[:] = available
        tissue._state.last_spike[:] = tissue._step
        spikes = tissue.advance(0.0125, [Pulse(tissue.now_s, x_um, y_um)])
        assert (spikes.time_s.size > 10) == passes


def test_a_neuron_stimulated_too_fast_fails() -> None:
    """In the long run a neuron driven at f spikes no faster than where loss x tau x rate = 1 / needed - 1."""
    parameters = dataclasses.replace(SILENT, weight_ee=0.0, weight_ei=0.0, weight_ie=0.0, weight_ii=0.0)
    tissue = Tissue(1, dataclasses.replace(parameters, hyperpolarisation=0.0, adaptation_mv=0.0, axon_reliability=1.0))
    needed = tissue._wiring.needed
    x_um, y_um = np.array([750.0]), np.array([500.0])
    near = tissue._coupling.reach(x_um, y_um)
    neuron = int(near.near[np.argmax(near.kick_mv)])
    tissue.advance(30.0, [Pulse(t, x_um, y_um) for t in np.arange(0.01, 30, 1 / 50)])
    spikes = tissue.advance(20.0, [Pulse(t, x_um, y_um) for t in np.arange(30.01, 50, 1 / 50)])
    rate_hz = np.sum(spikes.neuron == neuron) / 20.0
    critical_hz = (1 / needed[neuron] - 1) / (parameters.availability_loss * parameters.availability_s)
    assert rate_hz == pytest.approx(critical_hz, rel=0.1)
    assert rate_hz < 40


def test_strength_scales_what_a_pulse_reaches() -> None:
    tissue = Tissue(1)
    x_um, y_um = electrodes(200)
    counts = []
    for strength in (0.0, 0.5, 1.0, 2.0):
        kicks = tissue._coupling.kicks(Pulse(0.0, x_um, y_um, strength), 0)
        counts.append(np.sum(kicks.mv == AXONAL_KICK_MV))
    assert counts[0] == 0
    assert np.all(np.diff(counts) > 0)
    assert counts[1] / counts[2] == pytest.approx(0.5, abs=0.06)
    assert counts[3] / counts[2] == pytest.approx(2.0, abs=0.15)


# --- what is refused


def test_requests_that_cannot_be_met_are_refused_and_change_nothing() -> None:
    tissue = Tissue(1, SMALL)
    tissue.advance(0.1)
    place = np.array([700.0]), np.array([500.0])
    with pytest.raises(InvalidArgument, match="duration_s"):
        tissue.advance(-1.0)
    with pytest.raises(InvalidArgument, match="duration_s"):
        tissue.rest(float("nan"))
    for time_s in (0.05, 0.2, float("nan")):
        with pytest.raises(InvalidArgument, match="pulses"):
            tissue.advance(0.1, [Pulse(0.15, *place), Pulse(time_s, *place)])
    assert tissue.now_s == 0.1
    expected = Tissue(1, SMALL)
    expected.advance(0.1)
    assert_same_spikes(tissue.advance(0.3), expected.advance(0.3))
    with pytest.raises(InvalidArgument, match="strength"):
        Pulse(0.0, *place, strength=3.0)
    with pytest.raises(InvalidArgument, match="x_um, y_um"):
        Pulse(0.0, np.zeros(2), np.zeros(3))
    with pytest.raises(InvalidArgument, match="seed"):
        Tissue(-1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("neurons", 5),
        ("scaling_at_hz", -0.1),
        ("load_gain", 1.5),
        ("in_degree_i", 400),
        ("ampa_ms", 0.0),
        ("excitatory_share", 1.5),
        ("drive_mv", float("inf")),
        ("between_share", 0.0),
        ("delay_ms", -0.1),
        ("communities", 0),
        ("use", 0.0),
        ("recovery_ms", 0.0),
        ("facilitation_ms", -1.0),
    ],
)
def test_parameters_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    whole = TissueParameters()
    with pytest.raises(InvalidArgument, match=f"{name}.*: expected"):
        dataclasses.replace(whole if hasattr(whole, name) else whole.e_to_e, **{name: value})  # type: ignore[arg-type]


@pytest.mark.oracle
def test_the_example_of_the_docs_runs() -> None:
    text = (Path(__file__).parents[1] / "docs" / "virtual-culture.md").read_text(encoding="utf-8")
    names: dict[str, object] = {}
    exec(text.split("```python\n")[1].split("```")[0], names)
    tissue, evoked = names["tissue"], names["evoked"]
    assert isinstance(tissue, Tissue)
    assert isinstance(evoked, Spikes)
    assert tissue.now_s == 61.0125
    assert evoked.time_s.size > 20


def interrupted_after(n: int, patch: pytest.MonkeyPatch) -> None:
    """Let Ctrl-C come as the n-th call of the kernel returns."""
    advance, calls = kernel.advance, itertools.count(1)

    def pressed(*given: Any) -> int:
        written = advance(*given)
        if next(calls) == n:
            raise KeyboardInterrupt
        return written

    patch.setattr(kernel, "advance", pressed)


@pytest.mark.parametrize("n", [1, 3])
def test_interrupted_it_goes_on_from_where_it_is(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    undisturbed, tissue = Tissue(7, SMALL), Tissue(7, SMALL)
    for each in (undisturbed, tissue):
        each.advance(0.99999, pulses_over_a_second()[:-1])
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupted_after(n, patch)
        tissue.rest(60.0)
    assert tissue.now_s == 10 * n
    undisturbed.advance(10 * n - undisturbed.now_s)
    # Neither the state nor what earlier pulses have on its way is lost.
    assert_same_spikes(tissue.advance(12.0), undisturbed.advance(12.0))
    tissue.restore(tissue.snapshot())


def test_pulses_that_an_interrupted_delivery_has_not_come_to_are_not_delivered(monkeypatch: pytest.MonkeyPatch) -> None:
    tissue = Tissue(7, SILENT)
    many = [Pulse(each, np.full(3, 700.0), np.full(3, 500.0), 2.0) for each in (5.0, 15.0)]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupted_after(1, patch)
        tissue.advance(20.0, many)
    assert len(tissue.advance(10.0).time_s) == 0
    assert len(tissue.advance(1.0, [dataclasses.replace(many[0], time_s=20.0)]).time_s) > 0

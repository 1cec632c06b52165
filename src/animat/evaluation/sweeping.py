"""The compiled inner loops of dynamic programming: one step back in time, and a look ahead."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32

from animat.compilation import cached_njit

f4 = np.float32
ONE, TWO, HALF, SIXTH = f4(1), f4(2), f4(0.5), f4(1 / 6)

# Without the interpreter's lock: `animat run` predicts and runs its loop at the same time.
compiled = cached_njit(error_model="numpy", fastmath={"contract", "nsz"}, nogil=True)


@compiled
def cubic(place: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """The weights of four nodes for a value `place` steps from the first: the cubic polynomial through them."""
    f = place - ONE
    return (
        -f * (f - ONE) * (f - TWO) * SIXTH,
        (f + ONE) * (f - ONE) * (f - TWO) * HALF,
        -(f + ONE) * f * (f - TWO) * HALF,
        (f + ONE) * f * (f - ONE) * SIXTH,
    )


@compiled
def fill_row_weights(places: Float32[np.ndarray, " axes"], weights: Float32[np.ndarray, " taps"]) -> None:
    """The weights of the 4^axes rows around a state: products over the axes."""
    filled = 1
    weights[0] = ONE
    for axis in range(len(places)):
        w0, w1, w2, w3 = cubic(places[axis])
        for i in range(filled - 1, -1, -1):
            w = weights[i]
            weights[4 * i + 3] = w * w3
            weights[4 * i + 2] = w * w2
            weights[4 * i + 1] = w * w1
            weights[4 * i] = w * w0
        filled *= 4


@compiled
def bellman_backup(
    values: Float32[np.ndarray, " nodes_of_all_rows_and_layers"],
    rows: Int32[np.ndarray, "landings rows"],
    row_places: Float32[np.ndarray, "landings rows axes"],
    nodes: Int32[np.ndarray, "landings rows nodes"],
    places: Float32[np.ndarray, "landings rows nodes"],
    rewards: Float32[np.ndarray, "landings rows nodes"],
    row_offsets: Int32[np.ndarray, " taps"],
    outcomes: Int32[np.ndarray, "layers outcomes 2"],
    weights: Float32[np.ndarray, "layers actions outcomes"],
    remaining: int,
    lowest: np.float32,
    highest: np.float32,
    best: Float32[np.ndarray, " nodes_of_all_rows_and_layers"],
) -> None:
    """The value of each state under its best action, given the values of the next states.

        best_l(s) = max_a sum_o weights_l(a, o) (reward_k(s) + value_m(landing_k(s))),
        (k, m) = outcomes_l(o)

    Each case has one layer of values or, with memory, one for each class of the history. The rows around a landing are
    the same for all nodes of a row and for all layers. They are summed once; each node is interpolated along the row.

    Args:
        values: of the next states, at the grid's nodes: row by row, and layer by layer within a row.
        rows, row_places, nodes, places, rewards: the landings, as in `animat.evaluation.landings.Landings`.
        outcomes, weights: of the actions in each layer, the landing and the next layer, and their weights.
        remaining: iterations left after this one.
        lowest, highest: bounds of all values, which interpolation near a cliff could exceed.
        best: output, as `values`.
    """
    n_landings, n_rows, n_nodes = nodes.shape
    n_layers, n_actions, n_outcomes = weights.shape
    n_taps = len(row_offsets)
    width = n_nodes * n_layers
    tap_weights = np.empty(n_taps, np.float32)
    summed = np.empty(width, np.float32)
    landed = np.empty((n_landings, width), np.float32)
    worth = np.empty(n_nodes, np.float32)
    # The layers that follow a landing, from the first to the last, with those between.
    first_layer, end_layer = np.full(n_landings, n_layers), np.zeros(n_landings, np.int64)
    for layer in range(n_layers):
        for outcome in range(n_outcomes):
            k, then = outcomes[layer, outcome]
            first_layer[k], end_layer[k] = min(first_layer[k], then), max(end_layer[k], then + 1)
    for row in range(n_rows):
        for k in range(n_landings):
            alive = False
            for node in range(n_nodes):
                alive |= nodes[k, row, node] >= 0
            if alive:
                fill_row_weights(row_places[k, row], tap_weights)
                first = rows[k, row]
                if n_taps == 1:
                    # One by one: for slices numba would compile a check of equal lengths, which takes a third more.
                    for j in range(width):
                        summed[j] = values[first * width + j]
                else:
                    # Slices that begin at 0: an index that could be negative is tested at each access.
                    begin, length = first_layer[k] * n_nodes, (end_layer[k] - first_layer[k]) * n_nodes
                    sums = summed[begin : begin + length]
                    sums[:] = f4(0)
                    for tap in range(0, n_taps, 4):
                        w0, w1 = tap_weights[tap], tap_weights[tap + 1]
                        w2, w3 = tap_weights[tap + 2], tap_weights[tap + 3]
                        i0 = (first + row_offsets[tap]) * width + begin
                        i1 = (first + row_offsets[tap + 1]) * width + begin
                        i2 = (first + row_offsets[tap + 2]) * width + begin
                        i3 = (first + row_offsets[tap + 3]) * width + begin
                        v0, v1 = values[i0 : i0 + length], values[i1 : i1 + length]
                        v2, v3 = values[i2 : i2 + length], values[i3 : i3 + length]
                        for j in range(length):
                            sums[j] += (w0 * v0[j] + w1 * v1[j]) + (w2 * v2[j] + w3 * v3[j])
            for node in range(n_nodes):
                at = nodes[k, row, node]
                reward = rewards[k, row, node]
                if at < 0:
                    if at == -2 and remaining > 0:
                        reward += places[k, row, node]
                    for layer in range(n_layers):
                        landed[k, layer * n_nodes + node] = reward
                else:
                    w0, w1, w2, w3 = cubic(places[k, row, node])
                    for layer in range(first_layer[k], end_layer[k]):
                        around = summed[layer * n_nodes + at : layer * n_nodes + at + 4]
                        landed[k, layer * n_nodes + node] = reward + (
                            (w0 * around[0] + w1 * around[1]) + (w2 * around[2] + w3 * around[3])
                        )
        for layer in range(n_layers):
            start = row * width + layer * n_nodes
            row_best = best[start : start + n_nodes]
            row_best[:] = f4(-np.inf)
            for action in range(n_actions):
                worth[:] = f4(0)
                for outcome in range(n_outcomes):
                    weight = weights[layer, action, outcome]
                    if weight != f4(0):
                        k, then = outcomes[layer, outcome]
                        row_landed = landed[k, then * n_nodes : (then + 1) * n_nodes]
                        for node in range(n_nodes):
                            worth[node] += weight * row_landed[node]
                for node in range(n_nodes):
                    row_best[node] = max(row_best[node], worth[node])
            for node in range(n_nodes):
                row_best[node] = min(max(row_best[node], lowest), highest)


@compiled
def look_ahead(
    values: Float32[np.ndarray, "rows layers nodes"],
    rows: Int32[np.ndarray, "landings states"],
    row_places: Float32[np.ndarray, "landings states axes"],
    nodes: Int32[np.ndarray, "landings states"],
    places: Float32[np.ndarray, "landings states"],
    rewards: Float32[np.ndarray, "landings states"],
    row_offsets: Int32[np.ndarray, " taps"],
    layers: Int32[np.ndarray, " states"],
    outcomes: Int32[np.ndarray, "layers outcomes 2"],
    weights: Float32[np.ndarray, "layers actions outcomes"],
    remaining: int,
    chosen: Int32[np.ndarray, " states"],
) -> None:
    """Choose the best action in each of some states, by the values of the next states (see `bellman_backup`)."""
    n_states = nodes.shape[1]
    _, n_actions, n_outcomes = weights.shape
    n_taps = len(row_offsets)
    tap_weights = np.empty(n_taps, np.float32)
    landed = np.empty(n_outcomes, np.float32)
    for state in range(n_states):
        layer = layers[state]
        for outcome in range(n_outcomes):
            k, then = outcomes[layer, outcome]
            landed[outcome] = rewards[k, state]
            at = nodes[k, state]
            if at == -2 and remaining > 0:
                landed[outcome] += places[k, state]
            if at >= 0:
                fill_row_weights(row_places[k, state], tap_weights)
                w0, w1, w2, w3 = cubic(places[k, state])
                for tap in range(n_taps):
                    row = values[rows[k, state] + row_offsets[tap], then]
                    landed[outcome] += tap_weights[tap] * (
                        (w0 * row[at] + w1 * row[at + 1]) + (w2 * row[at + 2] + w3 * row[at + 3])
                    )
        highest = f4(-np.inf)
        for action in range(n_actions):
            worth = f4(0)
            for outcome in range(n_outcomes):
                worth += weights[layer, action, outcome] * landed[outcome]
            if worth > highest:
                highest = worth
                chosen[state] = action

"""Maps to and from their fields: bits of cells as arrays of booleans, counters as numbers."""

import numpy as np

from uuvtai.common.enums import FULL, occupancy

WORD = 64


def words(cells, beyond=False):
    """Booleans (..., n_col) as uint64 words (..., n_word); what lies beyond the grid is ``beyond``."""
    cells = np.asarray(cells, bool)
    missing = -cells.shape[-1] % WORD
    padded = np.concatenate([cells, np.full((*cells.shape[:-1], missing), beyond)], axis=-1)
    return np.ascontiguousarray(np.packbits(padded, axis=-1, bitorder="little")).view(np.uint64)


def cells(words_, n_col):
    """Booleans (..., n_col) of uint64 words (..., n_word)."""
    octets = np.ascontiguousarray(words_).view(np.uint8)
    return np.unpackbits(octets, axis=-1, bitorder="little").astype(bool)[..., :n_col]


def kept(occupancies):
    """A layer as the map keeps it."""
    return np.rint(np.asarray(occupancies) * FULL).astype(np.uint16)


def put_layers(grid_map, static, dynamic, occupied):
    """Both layers of every env, and the bits that follow from them."""
    static, dynamic = kept(static), kept(dynamic)
    grid_map.static_occ.from_numpy(static)
    grid_map.dynamic_occ.from_numpy(dynamic)
    grid_map.alive.from_numpy(words((static > 0) | (dynamic > 0)))
    grid_map.static_occupied.from_numpy(words(occupancy(static) >= occupied))
    grid_map.dynamic_occupied.from_numpy(words(occupancy(dynamic) >= occupied))


def put_map(grid_map, state, occupied, confident):
    """``state``: static, dynamic, free_scans, dynamic_scans, seen and depth_hit [n_env, row, col]."""
    put_layers(grid_map, state["static"], state["dynamic"], occupied)
    grid_map.dynamic_scans.from_numpy(np.ascontiguousarray(state["dynamic_scans"], np.uint8))
    grid_map.held.from_numpy(words(state["dynamic_scans"] > 0))
    grid_map.free_scans.from_numpy(
        np.stack([words(state["free_scans"] >> k & 1) for k in range(grid_map.free_scans.n)], axis=-1)
    )
    grid_map.confident.from_numpy(words(state["free_scans"] >= confident))
    grid_map.seen.from_numpy(words(state["seen"]))
    grid_map.depth_hit.from_numpy(words(state["depth_hit"]))
    grid_map.depth_waits.fill(1)


def get_map(grid_map):
    """What ``put_map`` takes, read back."""
    static = occupancy(grid_map.static_occ.to_numpy())
    n_col = static.shape[-1]
    counter = grid_map.free_scans.to_numpy()
    return {
        "static": static,
        "dynamic": occupancy(grid_map.dynamic_occ.to_numpy()),
        "dynamic_scans": grid_map.dynamic_scans.to_numpy(),
        "free_scans": sum(
            cells(counter[..., k].copy(), n_col).astype(int) << k for k in range(counter.shape[-1])
        ),
        "seen": cells(grid_map.seen.to_numpy(), n_col),
        "depth_hit": cells(grid_map.depth_hit.to_numpy(), n_col),
    }


def check_bits(grid_map, occupied, confident):
    """The bits say what the numbers say."""
    state = get_map(grid_map)
    said = {name: cells(getattr(grid_map, name).to_numpy(), state["static"].shape[-1]) for name in _FOLLOWS}
    np.testing.assert_array_equal(said["alive"], (state["static"] > 0) | (state["dynamic"] > 0))
    np.testing.assert_array_equal(said["static_occupied"], state["static"] >= occupied)
    np.testing.assert_array_equal(said["dynamic_occupied"], state["dynamic"] >= occupied)
    np.testing.assert_array_equal(said["held"], state["dynamic_scans"] > 0)
    np.testing.assert_array_equal(said["confident"], state["free_scans"] >= confident)


_FOLLOWS = ("alive", "static_occupied", "dynamic_occupied", "held", "confident")

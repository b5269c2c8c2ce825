"""Maps to and from their fields: bits of cells as arrays of booleans, counters as numbers."""

import numpy as np

from uuvtai.common.enums import FULL, NO_SITE, occupancy

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


def sites(row, col):
    """What the clearance keeps of nearest sites [.., row, col]; row -1 = none."""
    own_row, own_col = np.ogrid[: np.shape(row)[-2], : np.shape(row)[-1]]
    return np.where(row < 0, NO_SITE, away(row - own_row, col - own_col)).astype(np.int16)


def away(rows, cols):
    """What the clearance keeps of a site so many rows and columns away."""
    return np.asarray(rows) * 256 + (np.asarray(cols) & 127) * 2


def nearest_sites(kept):
    """(row, col) of nearest sites that the clearance keeps [.., row, col]; -1 = none."""
    own_row, own_col = np.ogrid[: kept.shape[-2], : kept.shape[-1]]
    near = kept != NO_SITE
    return np.where(near, own_row + (kept >> 8), -1), np.where(near, own_col + (kept << 8 >> 9), -1)


_AWAY = np.stack(np.meshgrid(np.arange(21), np.arange(21)), -1).reshape(-1, 2)
_AWAY = _AWAY[np.argsort(np.hypot(*_AWAY.T), kind="stable")]


def room(metres):
    """What the clearance keeps of the site whose distance is nearest to ``metres``, in cells of 0.1 m; none
    from 2 m on."""
    reach, cells_away = np.hypot(*_AWAY.T), np.asarray(metres) / 0.1
    above = np.searchsorted(reach, cells_away).clip(1, len(reach) - 1)
    nearest = above - (cells_away - reach[above - 1] < reach[above] - cells_away)
    return np.where(cells_away < 20, away(*np.moveaxis(_AWAY[nearest], -1, 0)), NO_SITE).astype(np.int16)


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

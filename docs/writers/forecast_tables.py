"""Tables of the learned forecast: how good it is beside others, and what the pilot gains by it."""

from __future__ import annotations

from docs.writers.figure_sources import Sources
from docs.writers.pieces import CELLS, PIECES, beside
from uuvtai.tables.table import text_table

FILE = "docs/data/forecasts.json"
PLAYED = ("docs/data/forecast_pieces_77001.json", "docs/data/forecast_pieces_77002.json")


def forecast_scores(sources: Sources) -> str:
    """Likelihood and distances of every forecast on episodes that no training met."""
    rows = []
    for cell in sources.json(FILE)["cells"]:
        for name, found in cell["methods"].items():
            near = f"{found['nearest_median_m']:.2f} / {found['nearest_p90_m']:.2f} m"
            rows.append(
                [
                    cell["cell"],
                    name,
                    f"{found['nll']:.2f}",
                    f"{found['likeliest_median_m']:.2f} / {found['likeliest_p90_m']:.2f} m",
                    near if name in ("with turns back", "learned") else "-",
                    ", ".join(f"{100 * share:.0f}" for share in found["coverage"]),
                    f"{100 * found['likeliest_said']:.0f}, {100 * found['likeliest_right']:.0f} %",
                ]
            )
    head = ["world (S, D, v in m/s)", "forecast", "NLL, nats", "likeliest at 2.5 s: median / p90"]
    more = ["nearest", "regions of 50, 80, 90, 95 % hold", "likeliest: said, right"]
    return text_table([*head, *more], rows)


def forecast_pieces(sources: Sources) -> str:
    """The pilot with the learned forecast beside itself, on the same episodes of both seeds."""
    played: dict[tuple[str, str], str] = {}
    for file in PLAYED:
        for row in sources.json(file)["rows"]:
            place = row["piece"], row["cell"]
            played[place] = played.get(place, "") + row["outcomes"]
    cells = [cell for cell in CELLS if any(found == cell.name for _piece, found in played)]
    rows = [
        [
            piece.title,
            f"`{piece.settings}`" if piece.settings else "",
            *(beside(played, piece.name, "all", cell.name) for cell in cells),
        ]
        for piece in PIECES
        if any(found == piece.name for found, _cell in played)
    ]
    return text_table(["changed", "by", *(cell.title for cell in cells)], rows)

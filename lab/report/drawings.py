"""Draws what the paper draws and no run decides: its figures 1, 4, 5, 8, 10 and 17, as they are built here.

    python lab/report/drawings.py lab/evidence/drawings

Writes one PNG file for each. Needs matplotlib.
"""

import argparse
import pathlib

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

INCHES, DOTS_PER_INCH = 0.5, 120
PLAIN, SPIKES, LEARNS = "#f2f2f2", "#cfe6f5", "#fbe3c0"  # what a box has: numbers, spikes, what the paper adds to it

# Each drawing has boxes, (x, y, text, colour), and arrows, (from, to, text), by the index of the box.
DRAWINGS = {
    "tokens": (
        [*((3.0 * i, 0, text, PLAIN) for i, text in enumerate(["G₀", "s₀", "a₀", "G₁", "s₁"])), (12.0, 3, "logits of a₁", PLAIN)],
        [(i, 5, "") for i in range(5)],
    ),
    "architecture": (
        [
            (0, 0, "G, s, a", PLAIN),
            (3, 0, "embedding,\nLayerNorm", PLAIN),
            (6, 0, "coder:\nspikes", SPIKES),
            (6, 2.4, "phase spikes", LEARNS),
            (9.4, 0, "queries, keys,\nvalues: spikes", SPIKES),
            (13, 0, "attention\na tick and head", SPIKES),
            (16.4, 0, "routing", LEARNS),
            (19.4, 0, "add,\nLayerNorm", PLAIN),
            (19.4, 2.4, "FFN: spikes", SPIKES),
            (22.8, 0, "readout coder:\nrates", SPIKES),
            (26.4, 0, "action head", LEARNS),
        ],
        [(0, 1, ""), (1, 2, ""), (2, 4, ""), (3, 4, ""), (4, 5, ""), (5, 6, ""), (6, 7, ""), (7, 8, ""), (8, 9, ""), (9, 10, "")],
    ),
    "plasticity": (
        [
            (0, 2.2, "readout rates r", SPIKES),
            (0, 0, "answer or action y", PLAIN),
            (5, 1.1, "trace\nE ← λ E + y rᵀ", LEARNS),
            (5, -1.6, "return G", PLAIN),
            (10, -1.6, "δ = (G - μ) / σ,\nlimited", LEARNS),
            (10, 1.1, "ΔW = η δ E,\nlimited", LEARNS),
            (15, 1.1, "head W", LEARNS),
        ],
        [(0, 2, ""), (1, 2, ""), (2, 5, ""), (3, 4, ""), (4, 5, ""), (5, 6, "")],
    ),
    "routing": (
        [
            *((0, 2.0 * i, f"head {3 - i}: y", SPIKES) for i in range(3)),
            (5, 4.6, "m hidden\nneurons, ReLU", LEARNS),
            (9.6, 4.6, "softmax over\nthe heads", LEARNS),
            (9.6, 2, "Σ gate × y", LEARNS),
            (14, 2, "mean over ticks,\nW_O", PLAIN),
        ],
        [(0, 3, ""), (1, 3, ""), (2, 3, ""), (0, 5, ""), (1, 5, ""), (2, 5, ""), (3, 4, ""), (4, 5, "gates"), (5, 6, "")],
    ),
    "data": (
        [
            (0, 1.2, "expert", PLAIN),
            (0, -1.2, "random actions,\nbursts", PLAIN),
            (4.4, 0, "episodes\n(o, a, r)", PLAIN),
            (8.6, 0, "returns-to-go,\nmoments", PLAIN),
            (13, 0, "clips of N steps,\nmask at the end", PLAIN),
            (17.4, 0, "spiketrain train", LEARNS),
        ],
        [(0, 2, ""), (1, 2, ""), (2, 3, ""), (3, 4, ""), (4, 5, "")],
    ),
    "hardware": (
        [
            (0, 0, "spiketrain train,\nfloat32", PLAIN),
            (4.8, 0, "quantize:\nintegers", PLAIN),
            (9.4, 1.3, "server: processor,\nSIMD", SPIKES),
            (9.4, -1.3, "to_nir:\nsnnTorch, chips", SPIKES),
            (14.4, 1.3, "spikes, operations,\nestimated energy", PLAIN),
            (14.4, -1.3, "simulated spikes", PLAIN),
        ],
        [(0, 1, ""), (1, 2, ""), (1, 3, ""), (2, 4, ""), (3, 5, "")],
    ),
}


def draw(boxes, arrows):
    xs, ys = [box[0] for box in boxes], [box[1] for box in boxes]
    width, height = max(xs) - min(xs) + 3.6, max(ys) - min(ys) + 1.8
    figure = Figure(figsize=(INCHES * width, INCHES * height), dpi=DOTS_PER_INCH)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    axis.set_xlim(min(xs) - 1.8, max(xs) + 1.8)
    axis.set_ylim(min(ys) - 0.9, max(ys) + 0.9)
    texts = [
        axis.text(
            x, y, text, ha="center", va="center", fontsize=8.5, bbox={"boxstyle": "round,pad=0.45", "fc": colour, "ec": "#555555"}
        )
        for x, y, text, colour in boxes
    ]
    FigureCanvasAgg(figure).draw()  # boxes have their sizes only now
    for start, end, label in arrows:
        patches = (texts[start].get_bbox_patch(), texts[end].get_bbox_patch())
        ends = boxes[start][:2], boxes[end][:2]
        axis.add_patch(
            FancyArrowPatch(
                *ends,
                patchA=patches[0],
                patchB=patches[1],
                arrowstyle="-|>",
                mutation_scale=9,
                color="#333333",
                shrinkA=2,
                shrinkB=2,
            )
        )
        middle = [(a + b) / 2 for a, b in zip(*ends, strict=True)]
        axis.text(*middle, label, fontsize=7.5, ha="left", va="bottom")
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path, help="folder of the PNG files")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, (boxes, arrows) in DRAWINGS.items():
        path = out / f"{name}.png"
        draw(boxes, arrows).savefig(path, metadata={"Software": None})
        print(path)


if __name__ == "__main__":
    main()

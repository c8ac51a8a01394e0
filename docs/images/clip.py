"""Draw the four cases of the clip with the library's own loss: python docs/images/clip.py

The clip's position is not coded here: the curve is `clipped_surrogate`, and its colour is the gradient that
torch derives from it.
"""

from __future__ import annotations

from pathlib import Path

import torch

from tightrope.maths.surrogate import clipped_surrogate

CLIP = 0.2
LOW, HIGH, POINTS = 0.4, 1.6, 121
WIDTH, HEIGHT, LEFT, TOP = 430, 250, 64, 66  # of one panel, and where the first begins
GAP = 62
FLOWS, ZERO, INK, FAINT, BAND = "#1f6feb", "#d9480f", "#1f2328", "#8c959f", "#eef2f6"
NOTES = {  # sign of the advantage -> (ratio, what happens there), from left to right
    1: [(0.5, "gradient flows"), (0.9, "2  gradient flows"), (1.4, "1  gradient 0: enough")],
    -1: [(0.6, "3  gradient 0: enough"), (0.9, "gradient flows"), (1.25, "4  not clipped: flows")],
}


def objective(advantage: float) -> tuple[list[float], list[float], list[bool]]:
    """Ratios, the objective min(r A, clip(r) A) there, and whether its gradient is 0."""
    log_ratio = torch.linspace(LOW, HIGH, POINTS, dtype=torch.float64).log()[None].requires_grad_()
    loss = clipped_surrogate(log_ratio, torch.full_like(log_ratio, advantage), CLIP)
    (gradient,) = torch.autograd.grad(loss.sum(), log_ratio)
    return log_ratio[0].exp().tolist(), (-loss[0]).tolist(), (gradient[0] == 0).tolist()


def text(x: float, y: float, words: str, size: int = 13, colour: str = INK, **more: str) -> str:
    """One line of text, centred unless ``text_anchor`` is given."""
    options = {"text-anchor": "middle", **{name.replace("_", "-"): value for name, value in more.items()}}
    extra = "".join(f' {name}="{value}"' for name, value in options.items())
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}"{extra}>{words}</text>'


def line(points: list[tuple[float, float]], colour: str, width: float, dash: str = "") -> str:
    """A line through points."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}"{dashes}/>'


def panel(advantage: int, left: float) -> list[str]:
    """One sign of the advantage."""
    top_value = HIGH + 0.1 if advantage > 0 else -LOW + 0.1
    bottom_value = LOW - 0.1 if advantage > 0 else -HIGH - 0.1

    def at(ratio: float, value: float) -> tuple[float, float]:
        x = left + (ratio - LOW) / (HIGH - LOW) * WIDTH
        return x, TOP + (top_value - value) / (top_value - bottom_value) * HEIGHT

    ratios, values, zero = objective(float(advantage))
    start, end = at(1 - CLIP, 0)[0], at(1 + CLIP, 0)[0]
    sign = "&gt;" if advantage > 0 else "&lt;"
    verdict = "better" if advantage > 0 else "worse"
    parts = [
        f'<rect x="{start:.1f}" y="{TOP}" width="{end - start:.1f}" height="{HEIGHT}" fill="{BAND}"/>',
        text(left + WIDTH / 2, TOP - 16, f"A {sign} 0: the action was {verdict} than expected", 15),
        line([(left, TOP), (left, TOP + HEIGHT), (left + WIDTH, TOP + HEIGHT)], FAINT, 1),
        line([at(r, r * advantage) for r in ratios], FAINT, 1.2, "4 4"),
    ]
    for ratio in (0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6):
        x = at(ratio, 0)[0]
        parts.append(line([(x, TOP + HEIGHT), (x, TOP + HEIGHT + 5)], FAINT, 1))
        parts.append(text(x, TOP + HEIGHT + 20, f"{ratio:g}", 12, FAINT))
    first = 0
    for last in range(1, POINTS):  # a stretch of one colour ends where the gradient begins or ceases to be 0
        if last == POINTS - 1 or zero[last] != zero[first]:
            colour = ZERO if zero[first] else FLOWS
            parts.append(line([at(ratios[i], values[i]) for i in range(first, last + 1)], colour, 3.5))
            first = last
    for ratio, words in NOTES[advantage]:
        index = min(range(POINTS), key=lambda i: abs(ratios[i] - ratio))
        x, y = at(ratio, values[index])
        if zero[index]:
            parts.append(text(x, y + 20, words, 13, ZERO))
        else:  # beside the slope, on its free side
            shift = 14 if advantage > 0 else -8
            parts.append(text(x + 10, y + shift, words, 13, FLOWS, text_anchor="start"))
    return parts


def draw() -> str:
    """The whole picture as SVG text."""
    width, height = LEFT + 2 * WIDTH + GAP + 24, TOP + HEIGHT + 82
    middle = height - 20
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="Helvetica, Arial, sans-serif">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        text(width / 2, 26, "PPO: min( r A,  clip(r, 0.8, 1.2) A )", 17),
        *panel(1, LEFT),
        *panel(-1, LEFT + WIDTH + GAP),
        text(width / 2, TOP + HEIGHT + 42, "r = new / old probability of the action; shaded: 1 ± clip", 13),
        line([(width / 2 - 290, middle - 4), (width / 2 - 262, middle - 4)], FLOWS, 3.5),
        text(width / 2 - 254, middle, "gradient flows", 13, text_anchor="start"),
        line([(width / 2 - 128, middle - 4), (width / 2 - 100, middle - 4)], ZERO, 3.5),
        text(width / 2 - 92, middle, "gradient exactly 0", 13, text_anchor="start"),
        line([(width / 2 + 60, middle - 4), (width / 2 + 88, middle - 4)], FAINT, 1.2, "4 4"),
        text(width / 2 + 96, middle, "r A, without the clip", 13, text_anchor="start"),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(draw(), encoding="utf-8")

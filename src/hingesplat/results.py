"""Recorded runs as tables: the page of results, the README's table, and the paper's tables beside ours."""

import json
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hingesplat.errors import HingesplatError
from hingesplat.files import read_json, write_text

Row = dict[str, Any]
"""A run: what ``bench.Case`` says of it, and its ``summary`` and ``metrics``, or its ``error``."""
BROKEN_ROW = "delete it, and that run is made again"
"""What to do about a row that cannot be read."""

PAPER_OBJECTS = (
    *("foldchair", "fridge", "laptop", "oven", "scissor", "stapler", "usb", "washer", "blade", "storage"),
    *("fridge3", "table4", "table5", "storage3", "storage4", "storage7", "oven4"),
)
"""The made objects after the paper's table 7."""
TITLES = {
    "angle": "axis °",
    "position": "position",
    "motion": "motion",
    "cd_static": "CD-s",
    "cd_movable": "CD-m",
    "cd_whole": "CD-w",
    "penetration": "penetration",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "minutes": "minutes",
}
"""Columns of the paper's tables."""
PAPER_TERMS = {
    "articulate.identity.kind": "embedding",
    "articulate.physics.art": "1.0",
    "articulate.physics.contact": "0.5",
    "articulate.physics.vector": "0.5",
    "articulate.physics.velocity": "0.5",
    "articulate.repel.points": "2000",
    "fuse.strategy": "global",
}
"""What ``part2gs`` has by itself; tables put it on top of ``hingesplat``'s start, too."""
HIGHER_IS_BETTER = ("psnr", "ssim")
SAME = 0.1
"""Two figures that differ by a smaller fraction than this count as the same."""
LAST_PLACE = 0.01
"""So do two of the paper's that differ by one in their last place."""
WORST = 3
"""Pictures on the page for each section."""
BAD_AXIS = 5.0
"""Degrees from which a joint is named as a failure."""


# The paper's tables.


@dataclass(frozen=True)
class Variant:
    """A row of one of the paper's tables."""

    name: str
    options: dict[str, str]
    """Of ``reconstruct``, beside those of the full method."""
    method: str | None = None
    """Set where the rows of the table are methods."""


@dataclass(frozen=True)
class Table:
    """A table of the paper's supplement: what it compares on which objects, and its figures."""

    number: int
    title: str
    objects: tuple[str, ...]
    """Names of our made objects that stand in for the paper's."""
    reference: str
    """The variant that the others are compared with."""
    variants: tuple[Variant, ...]
    metrics: tuple[str, ...]
    paper: dict[str, dict[str, dict[str, float | None]]]
    """By object (or ``all``), variant and metric."""
    given: bool = False
    """Whether its subject is the number of parts given."""
    average: bool = False
    """Whether it averages over its objects."""
    note: str = ""

    @property
    def ablates(self) -> bool:
        """Whether its rows are variants of one method."""
        return any(v.method is None for v in self.variants)

    def each(self, methods: Sequence[str]) -> list[tuple[Variant, str]]:
        """Every variant with the method that it is a variant of."""
        return [(v, base) for base in (methods if self.ablates else ("",)) for v in self.variants]


def paper_table(number: int) -> Table:
    """One of tables 4 to 15. Raises HingesplatError for any other number."""
    known = json.loads(files("hingesplat").joinpath("paper_tables.json").read_text(encoding="utf-8"))
    if str(number) not in known:
        raise HingesplatError(f"table {number}: the paper's supplement has tables {', '.join(known)}")
    facts = known[str(number)]
    variants = tuple(Variant(**v) for v in facts.pop("variants"))
    objects, metrics = tuple(facts.pop("objects")), tuple(facts.pop("metrics"))
    return Table(number, objects=objects, metrics=metrics, variants=variants, **facts)


def variant_options(table: Table, changes: dict[str, str], method: str) -> dict[str, str]:
    """Options of ``reconstruct`` that make a table's variant of a method; none of them merely repeats a default."""
    if not table.ablates:
        return {}
    if method == "hingesplat":
        return changes if table.given else PAPER_TERMS | changes
    return {k: v for k, v in changes.items() if PAPER_TERMS.get(k) != v and (k, v) != ("parts", "K")}


# Numbers of runs.


def load_rows(out: Path) -> list[Row]:
    """Every recorded run, by name of its file.

    Raises:
        HingesplatError: a row is broken.
    """
    return [{"name": path.stem} | read_json(path, BROKEN_ROW) for path in sorted((out / "runs").glob("*.json"))]


def measured(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if "metrics" in row]


def joint_values(row: Row, key: str) -> list[float]:
    return [j[key] for j in row["metrics"]["joints"] if j[key] is not None]


def seconds_of(row: Row, *stages: str) -> list[float]:
    """One number, those of some stages of a run together; none where the machine had other work meanwhile."""
    seconds = row["summary"]["seconds"]
    return [sum(seconds.get(stage, 0.0) for stage in stages)] if seconds else []


def number_of(row: Row, metric: str) -> float | None:
    """One of ``TITLES`` for a run; means over its joints or movable parts.

    Motion is, as in the literature, the mean over joints of degrees for hinges and units for slides.
    """
    m = row["metrics"]
    match metric:
        case "angle":
            values = joint_values(row, "axis_deg")
        case "position":
            values = joint_values(row, "position_x10")
        case "motion":
            values = joint_values(row, "motion_deg") + joint_values(row, "motion_units")
        case "cd_static" | "cd_whole":
            values = [m["cd"][metric.removeprefix("cd_")]]
        case "cd_movable":
            values = [m["cd"]["movable_mean"]]
        case "penetration":
            values = [m["penetration"]["volume_fraction"]]
        case "minutes":
            values = [s / 60 for s in seconds_of(row, "total")]
        case _:
            values = [m["views"][metric]]
    there = [v for v in values if v is not None]
    return float(np.mean(there)) if there else None


def spread(values: Sequence[float | None], digits: int) -> str:
    """Mean ± standard deviation of what is there."""
    there = [v for v in values if v is not None]
    if not there:
        return "–"
    text = f"{np.mean(there):.{digits}f}"
    return text if len(there) < 2 else f"{text} ± {np.std(there):.{digits}f}"


def volumes_off(row: Row) -> list[float]:
    """Percent by which the volumes of a run's parts are off, where they are known."""
    return [100 * abs(v - 1) for v in row["metrics"].get("volumes", []) if v is not None]


def parts_right(row: Row) -> bool:
    return row["metrics"]["parts_found"] == row["metrics"]["parts_true"]


def given(rows: Sequence[Row]) -> str:
    """What the method was told."""
    told = {k for row in measured(rows) for k, v in row["summary"]["given"].items() if v}
    return ", ".join(sorted(told)) or ("nothing" if measured(rows) else "–")


def grouped(rows: Sequence[Row], *keys: str) -> dict[tuple, list[Row]]:
    """Rows by the values of some keys, in the order in which these first appear."""
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[k] for k in keys), []).append(row)
    return groups


def cells(rows: Sequence[Row]) -> dict[str, str]:
    """One line of a table: the runs of one object, mean ± standard deviation over them.

    Axis, position and motion are those of a run's worst joint.
    """
    good, name = measured(rows), rows[0]["subject"]
    failed = len(rows) - len(good)
    if not good:
        return {"object": name, "parts": f"failed: {rows[0]['error']}"}

    def worst(key: str) -> list[float | None]:
        return [max(joint_values(row, key), default=None) for row in good]

    def seconds(*stages: str) -> list[float]:
        return [s for r in good for s in seconds_of(r, *stages)]

    joints = [j for r in good for j in r["metrics"]["joints"]]
    right = sum(j["type_true"] == j["type_found"] for j in joints)
    return {
        "object": name + (f" ({failed} failed)" if failed else ""),
        "parts": ", ".join(sorted({f"{r['metrics']['parts_found']}/{r['metrics']['parts_true']}" for r in good})),
        "types": f"{right}/{len(joints)}",
        "axis °": spread(worst("axis_deg"), 3),
        "position": spread(worst("position_x10"), 3),
        "motion °": spread(worst("motion_deg"), 3),
        "motion, units": spread(worst("motion_units"), 4),
        "PSNR": spread([number_of(r, "psnr") for r in good], 1),
        "CD-s": spread([number_of(r, "cd_static") for r in good], 2),
        "CD-m": spread([number_of(r, "cd_movable") for r in good], 2),
        "CD-w": spread([number_of(r, "cd_whole") for r in good], 2),
        "volume off, %": spread([max(volumes_off(r), default=None) for r in good], 0),
        "penetration": spread([number_of(r, "penetration") for r in good], 3),
        "seconds": spread(seconds("total"), 0),
        "fit s": spread(seconds("stereo", "fit"), 0),
        "segment s": spread(seconds("segment"), 0),
        "joint s": spread(seconds("align", "fuse", "articulate", "joints"), 0),
        "rest s": spread(seconds("mesh", "export", "pictures"), 0),
        "MB": spread([r["summary"]["peak_memory_mb"] for r in good], 0),
        "given": given(rows),
    }


def overview(rows: Sequence[Row]) -> dict[str, str]:
    """One line of a table: all runs of one method. Medians over joints, parts and runs."""
    good, name = measured(rows), rows[0]["method"]
    line = {"method": name, "given": given(rows), "runs": str(len(rows)), "failed": str(len(rows) - len(good))}
    if not good:
        return line

    def middle(values: Sequence[float | None], digits: int, worst: bool = False) -> str:
        there = [v for v in values if v is not None]
        if not there:
            return "–"
        most = f" (≤ {max(there):.{digits}f})" if worst else ""
        return f"{np.median(there):.{digits}f}{most}"

    def joints(key: str) -> list[float]:
        return [v for row in good for v in joint_values(row, key)]

    found = [j for r in good for j in r["metrics"]["joints"] if j["part"] is not None]
    return line | {
        "K right": f"{sum(map(parts_right, good))}/{len(good)}",
        "types right": f"{sum(j['type_true'] == j['type_found'] for j in found)}/{len(found)}",
        "axis °": middle(joints("axis_deg"), 3, worst=True),
        "pivot": middle(joints("pivot"), 4),
        "motion °": middle(joints("motion_deg"), 3),
        "motion, units": middle(joints("motion_units"), 4),
        "CD-s": middle([number_of(r, "cd_static") for r in good], 2),
        "CD-m": middle([number_of(r, "cd_movable") for r in good], 2, worst=True),
        "CD-w": middle([number_of(r, "cd_whole") for r in good], 2),
        "volume off, %": middle([v for r in good for v in volumes_off(r)], 0, worst=True),
        "penetration": middle([number_of(r, "penetration") for r in good], 3),
        "PSNR": middle([number_of(r, "psnr") for r in good], 1),
        "minutes": middle([number_of(r, "minutes") for r in good], 1),
        "MB": middle([r["summary"]["peak_memory_mb"] for r in good], 0),
    }


def markdown(lines: Sequence[dict[str, str]], leave_out: Sequence[str] = ()) -> list[str]:
    """Lines of cells as a Markdown table."""
    head = [title for title in max(lines, key=len) if title not in leave_out]
    table = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return table + ["| " + " | ".join(line.get(title, "") for title in head) + " |" for line in lines]


def failures(rows: Sequence[Row]) -> Iterator[str]:
    """Every run that failed or found something else, in words."""
    for row in rows:
        wrong = []
        if "error" in row:
            wrong = [f"failed: {row['error']}"]
        else:
            m = row["metrics"]
            if not parts_right(row):
                wrong.append(f"{m['parts_found']} parts of {m['parts_true']}")
            for j in m["joints"]:
                if j["part"] is None:
                    wrong.append(f"{j['truth']} missed")
                elif j["type_found"] != j["type_true"]:
                    wrong.append(f"{j['truth']} is {j['type_true']}, found {j['type_found'] or 'fixed'}")
                elif j["axis_deg"] > BAD_AXIS:
                    wrong.append(f"axis of {j['truth']} off by {j['axis_deg']:.0f}°")
        if wrong:
            yield f"- {row['subject']}, {row['method']}, seed {row['seed']}: {'; '.join(wrong)}"


def badness(row: Row) -> tuple:
    """Orders runs from good to bad."""
    m = row["metrics"]
    missed = sum(j["part"] is None or j["type_found"] != j["type_true"] for j in m["joints"])
    return abs(m["parts_found"] - m["parts_true"]), missed, number_of(row, "cd_movable") or 0.0


# The page.


def write_page(page: Path, rows: Sequence[Row], out: Path) -> Path:
    """Everything that was recorded as Markdown, pictures of the worst beside it; returns its path."""
    page.parent.mkdir(parents=True, exist_ok=True)
    plain = [row for row in rows if not row["options"]]
    text = [
        "# Results",
        "",
        "Made by `hingesplat bench` and `hingesplat table N`; nothing here is written by hand. ± is the standard",
        "deviation over seeds; a seed draws the object as well as every random choice. Truth is opened after a run",
        "has ended, and the last iterate counts. *Given* is what a method was told: `parts` is the true number of",
        "parts; joint types are told to none. A joint that was not found counts 90°. Chamfer distances as in the",
        "literature (squared, both directions, × 1000), penetration as a fraction of a part's volume, volume off as",
        "what the worst part's lacks or has too much (the median over parts in tables of methods). Times are one",
        "run's alone; first stages taken over from another run count as they were measured there. A dash stands where",
        "the machine had other work, too, or where a run was recorded before the figure was taken.",
        "",
        *_machines(rows),
    ]
    for made, title in ((True, "Made objects"), (False, "Captures")):
        chosen = [row for row in plain if (row["views"] is not None) == made]
        for (preset, views, size), mine in grouped(chosen, "preset", "views", "size").items():
            text += ["", f"## {title}, {_scale(preset, views, size)}", "", *_section(page, mine, out)]
    text += _paper_section(rows)
    return write_text(page, "\n".join(text) + "\n")


def _machines(rows: Sequence[Row]) -> list[str]:
    machines = sorted({r["summary"]["machine"] for r in measured(rows)})
    if not machines:
        return ["No run has been recorded yet."]
    days = Counter(r.get("recorded", "before that was taken down") for r in measured(rows))
    runs = ", ".join(f"{day} {n}" for day, n in sorted(days.items()))
    return [f"Machine: {'; '.join(machines)}. Runs, by the day they were made: {runs}."]


def _scale(preset: str, views: int | None, size: int | None) -> str:
    return f"{preset} preset" + (f", {views} views of {size} × {size} a state" if views else "")


def _section(page: Path, rows: Sequence[Row], out: Path) -> list[str]:
    by_method = grouped(rows, "method")
    text = ["Medians over all joints, parts and runs; in brackets the worst.", ""]
    text += markdown([overview(mine) for mine in by_method.values()])
    if calibration := _calibration(measured(by_method.get(("hingesplat",), []))):
        text += ["", calibration]
    if beside := _side_by_side(by_method):
        text += ["", *beside]
    for (method,), mine in by_method.items():
        lines = [cells(same) for same in grouped(mine, "subject").values()]
        text += ["", f"### {method}", "", "Axis, position and motion are those of an object's worst joint.", ""]
        text += markdown(lines, leave_out=("fit s", "segment s", "joint s", "rest s"))
    named = list(failures(rows))
    if named:
        text += ["", "### What went wrong", "", *named]
    worst = sorted(measured(by_method.get(("hingesplat",), [])), key=badness, reverse=True)
    pictures = [line for r in worst[:WORST] for line in _picture(page, r, out)]
    if pictures:
        text += ["", "### The worst of hingesplat", *pictures]
    return text


def _calibration(rows: Sequence[Row]) -> str:
    """How often the truth lies within two of the standard deviations that the twins of these runs name."""
    joints = [j for row in rows for j in row["metrics"]["joints"] if j["type_true"] == j["type_found"]]
    shares = []
    for name, keys in (("axis", ["axis_deg"]), ("pivot", ["pivot"]), ("motion", ["motion_deg", "motion_units"])):
        pairs = [(j[key], j.get("std", {}).get(key)) for j in joints for key in keys]
        within = [error <= 2 * std for error, std in pairs if error is not None and std is not None]
        if within:
            shares.append(f"{name} {sum(within)} of {len(within)}")
    return f"The truth lies within two of hingesplat's standard deviations: {', '.join(shares)}." if shares else ""


def _side_by_side(by_method: dict[tuple, list[Row]]) -> list[str]:
    """Where another method's median beats ours on the runs that both finished."""
    ours = {(r["subject"], r["seed"]): r for r in measured(by_method.get(("hingesplat",), []))}
    text = []
    for (method,), rows in by_method.items():
        pairs = [(ours[key], r) for r in measured(rows) if (key := (r["subject"], r["seed"])) in ours]
        if method == "hingesplat" or not pairs:
            continue
        better = []
        for metric, title in TITLES.items():
            both = [(number_of(a, metric), number_of(b, metric)) for a, b in pairs]
            known = [(a, b) for a, b in both if a is not None and b is not None]
            if known:
                a, b = np.median(np.array(known), axis=0)
                if (b > a) if metric in HIGHER_IS_BETTER else (b < a):
                    better.append(f"{title} ({b:.3g} against {a:.3g})")
        what = ", ".join(better) or "nothing"
        text.append(f"- Side by side (runs: {len(pairs)}), {method}'s median is better in: {what}.")
    return text


def _picture(page: Path, row: Row, out: Path) -> list[str]:
    """The run's small summary, copied beside the page."""
    source = out / "summaries" / f"{row['name']}.jpg"
    target = page.parent / "pictures" / source.name
    if source.is_file():
        target.parent.mkdir(exist_ok=True)
        shutil.copy2(source, target)
    if not target.is_file():
        return []
    m = row["metrics"]
    told = f"{m['parts_found']} parts of {m['parts_true']}, CD-m {number_of(row, 'cd_movable') or 0:.2f}"
    return ["", f"{row['subject']}, seed {row['seed']}: {told}", "", f"![{row['subject']}](pictures/{target.name})"]


def _paper_section(rows: Sequence[Row]) -> list[str]:
    text: list[str] = []
    for number in range(4, 16):
        table = paper_table(number)
        mine = [row for row in rows if row["views"] is not None and row["subject"] in table.objects]
        for (preset, views, size), same in grouped(mine, "preset", "views", "size").items():
            for base in ("part2gs", "hingesplat") if table.ablates else ("",):
                found = by_variant(table, same, base)
                if len({variant for _, variant in found} & {v.name for v in table.variants}) > 1:
                    title = f"### Table {number}: {table.title}" + (f"; {_base_name(table, base)}" if base else "")
                    text += ["", title, "", f"{_scale(preset, views, size)}. {table.note}".strip(), ""]
                    text += markdown(table_lines(table, found))
                    if compared := trends(table, found):
                        text += ["", *compared]
    head = (
        "In brackets the paper's figures: other objects of the same names, other pictures, 30 000 + 5 000 iterations",
        "on a GPU. Position is ten times the distance of the axes; motion is the mean over joints of degrees for",
        "hinges and units for slides, as the literature has it.",
    )
    return ["", "## The paper's tables", "", *head, *text] if text else []


def _base_name(table: Table, base: str) -> str:
    if base == "part2gs":
        return "part2gs (random start)"
    return "hingesplat" if table.given else "the paper's terms on hingesplat's start"


def by_variant(table: Table, rows: Sequence[Row], base: str) -> dict[tuple[str, str], list[Row]]:
    """Runs by object (or ``all``) and name of variant; ``as it is`` is the base method with nothing changed."""
    known = [
        (v.name, v.method or base, variant_options(table, v.options, v.method or base)) for v, _ in table.each([base])
    ]
    if table.ablates and not table.given and all(options for _, _, options in known):
        known.append((f"{base} as it is", base, {}))
    objects = ("all",) if table.average else table.objects
    found = {}
    for subject, (name, method, options) in product(objects, known):
        mine = [
            r for r in rows if subject in ("all", r["subject"]) and r["method"] == method and r["options"] == options
        ]
        if mine:
            found[subject, name] = mine
    return found


def table_lines(table: Table, found: dict[tuple[str, str], list[Row]]) -> list[dict[str, str]]:
    """A line an object and variant: our mean ± std, and in brackets the paper's figure."""
    lines = []
    for (subject, name), rows in found.items():
        good = measured(rows)
        parts = ", ".join(sorted({f"{r['metrics']['parts_found']}/{r['metrics']['parts_true']}" for r in good}))
        failed = f" ({len(rows) - len(good)} failed)" if len(good) < len(rows) else ""
        line = {"object": subject + failed, "": name, "parts": parts or "–"}
        for metric in table.metrics:
            theirs = table.paper.get(subject, {}).get(name, {}).get(metric)
            ours = spread([number_of(r, metric) for r in good], 3 if metric in ("penetration", "ssim", "lpips") else 2)
            line[TITLES[metric]] = ours if theirs is None else f"{ours} ({theirs:g})"
        lines.append(line)
    return lines


@dataclass(frozen=True)
class Figure:
    """A number of a variant on an object, ours or the paper's."""

    mean: float
    noise: float
    """What it may be off by without meaning anything: two standard errors of ours, rounding of the paper's."""

    def beside(self, reference: "Figure") -> int:
        """−1 if lower than the reference, 1 if higher, 0 if the same but for noise."""
        difference = self.mean - reference.mean
        scale = max(abs(self.mean), abs(reference.mean))
        if abs(difference) <= max(SAME * scale, float(np.hypot(self.noise, reference.noise))):
            return 0
        return 1 if difference > 0 else -1


def trends(table: Table, found: dict[tuple[str, str], list[Row]]) -> list[str]:
    """Where the variants do not stand to the reference as they do in the paper.

    Where both failed to find the joints, their figures say nothing.
    """
    same, failed, unseen, opposite = 0, [], [], []
    for (subject, name), rows in found.items():
        against = found.get((subject, table.reference), [])
        theirs = table.paper.get(subject, {})
        if name == table.reference or table.reference not in theirs or name not in theirs:
            continue
        if table.ablates and _lost(rows) and _lost(against):
            failed.append(f"{name} of {subject}")
            continue
        for metric in table.metrics:
            figures = [theirs[n].get(metric) for n in (name, table.reference)]
            ours = [_figure(r, metric) for r in (rows, against)]
            if None in figures or None in ours:
                continue
            paper = [Figure(f, LAST_PLACE / 2**0.5) for f in figures if f is not None]
            known = [f for f in ours if f is not None]
            expected, seen = paper[0].beside(paper[1]), known[0].beside(known[1])
            words = f"{TITLES[metric]} of {subject}, {name}: {known[0].mean:.3g} against {known[1].mean:.3g}"
            words += f" (paper {figures[0]:g} against {figures[1]:g})"
            if expected == seen:
                same += 1
            elif expected and seen:
                opposite.append(words)
            else:
                unseen.append(words)
    total = same + len(unseen) + len(opposite)
    text = []
    if failed:
        text.append(f"Like `{table.reference}`, these miss the joints by more than {BAD_AXIS:g}°: {', '.join(failed)}.")
        text.append("No trend is read from them.")
    if total:
        text.append(f"Beside `{table.reference}`, {same} of {total} comparisons come out as in the paper.")
    for title, words in (("The other way round:", opposite), ("A difference on one side only:", unseen)):
        if words:
            text += ["", title, "", *(f"- {w}" for w in words)]
    return text


def _lost(rows: Sequence[Row]) -> bool:
    axis = _figure(rows, "angle")
    return axis is None or axis.mean > BAD_AXIS


def _figure(rows: Sequence[Row], metric: str) -> Figure | None:
    values = [v for row in measured(rows) if (v := number_of(row, metric)) is not None]
    if not values:
        return None
    return Figure(float(np.mean(values)), float(2 * np.std(values) / np.sqrt(len(values))))

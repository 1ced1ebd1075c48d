"""The report of the study: one HTML file with everything in it, and the tables and figures beside it."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pumpbench.files import write_file
from pumpbench.study import figures, paper, selection, statistics, tables

PAPER_PATIENTS, PAPER_DAYS = 10, 14


@dataclass(frozen=True)
class ResultSet:
    """The results of one set of pramlintide parameters, all parts."""

    name: str
    runs: pd.DataFrame
    about: str = ""


def write_report(
    folder: Path,
    results: ResultSet,
    *,
    others: Sequence[ResultSet] = (),
    curves: figures.CurveSet | None = None,
    six: figures.CurveSet | None = None,
    ten: figures.CurveSet | None = None,
    meals: Sequence[figures.Meal] = (),
    sensitivity: pd.DataFrame | None = None,
    explanations: Mapping[str, str] | None = None,
    settings: Mapping[str, str] | None = None,
    seconds: float | None = None,
) -> Path:
    """Write tables, figures and report.html of a study into a folder and return the report's path.

    Args:
        folder: where to; made if it is not there, files of the same names are replaced.
        results: what the tables and figures are about.
        others: further sets to show beside it; their validation part is enough.
        curves: the validation's, as its `meals`; its ratio is the chosen one.
        six: of strategies 2 and 4 with 6 ug/U.
        ten: the same with 10 ug/U.
        meals: see curves.
        sensitivity: a table shown as it is, its column names as headings.
        explanations: why something does not agree, by "nma s2 hbgi" (comparator, strategy, metric), by "s2 hbgi" (the
            mode's cell, and contrasts of it that have none of their own) or by "hbgi" (everything of that metric).
        settings: what else to tell, by name: versions, parameters.
        seconds: how long the study took.

    Raises:
        ValueError: the results cannot be used, or an explanation is of nothing there is; says which.
    """
    explanations = explanations or {}
    _check_explanations(explanations)
    runs = results.runs
    alone = statistics.validation(runs)
    tables.write_tables(folder, runs)
    drawn = figures.write_figures(folder, runs, curves, six, meals, ten)

    def picture(name: str, caption: str) -> Markup:
        if name not in drawn:
            return Markup("")
        data = base64.b64encode(drawn[name].read_bytes()).decode()
        form = '<figure><img alt="{}" src="data:image/png;base64,{}"><figcaption>{}</figcaption></figure>'
        return Markup(form).format(caption, Markup(data), caption)

    sets = [_digest(one) for one in (results, *others)]
    cells = statistics.compare_cells(statistics.cells(alone))
    model_error = statistics.fast_path_error(alone)
    _, seeds = statistics.by_seed(alone)
    contrasts = sets[0]["all"]
    page = _environment().get_template("report.html.j2")
    text = page.render(
        results=results,
        patients=alone["patient"].nunique(),
        days=" or ".join(f"{days:g}" for days in sorted(set(alone["days"]))) if "days" in alone else "?",
        seeds=sorted(set(alone["seed"])),
        duration=_duration(seconds),
        warnings=list(_warnings(alone, contrasts)),
        counts=sets[0]["counts"],
        modes=[mode for mode in paper.MODES if mode in set(alone["mode"])],
        all_modes=paper.MODES,
        model_error=None if np.isnan(model_error) else model_error,
        picture=picture,
        contrast_metrics=paper.CONTRAST_METRICS,
        cell_metrics=paper.TABLE2_METRICS,
        names=figures.NAMES,
        units=figures.UNITS,
        contrasts=contrasts.to_dict("records"),
        cells={(row["mode"], row["metric"]): row for row in cells.to_dict("records")},
        text_contrasts=statistics.text_contrasts(runs).to_dict("records"),
        differing=list(_differing(contrasts, cells, explanations)),
        inconsistencies=_inconsistencies(),
        selections=_selections(runs),
        tir_margin=selection.TIR_MARGIN,
        tbr_margin=selection.TBR_MARGIN,
        over_time=any(name in drawn for name in ("strategies_over_time", "ratio_6_and_10")),
        sets=sets,
        paper_tir=paper.table2().query("metric == 'tir_70_180'").set_index("mode")["mean"].to_dict(),
        seed_rows=seeds.to_dict("records"),
        sensitivity=sensitivity,
        settings=settings or {},
    )
    write_file(folder / "report.html", text.encode())
    return folder / "report.html"


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("pumpbench.study", "."),
        autoescape=True,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    environment.filters |= {"number": _number, "pvalue": _p, "cell": _cell, "text": _text}
    return environment


def _number(value: float, digits: int) -> str:
    if np.isnan(value):
        return "–"
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")  # + 0.0: no -0.00


def _p(value: float) -> str:
    if np.isnan(value):
        return "–"
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _cell(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (float, np.floating)):
        return _number(float(value), 2)
    return str(value)


def _text(name: str) -> str:
    """`s2 ratio=10` as S2 with 10 µg/U, `ma` as MA."""
    mode, _, rest = name.partition(" ")
    return mode.upper() + (
        f" with {rest.removeprefix('ratio=')} µg/U" if rest.startswith("ratio=") else f" {rest}" * bool(rest)
    )


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _digest(results: ResultSet) -> dict[str, Any]:
    alone = statistics.validation(results.runs)
    compared = statistics.compare(statistics.contrasts(alone))
    means = statistics.cells(alone, ["tir_70_180"])
    tir = compared[compared["metric"] == "tir_70_180"].to_dict("records")
    return {
        "name": results.name,
        "about": results.about,
        "all": compared,
        "contrasts": {(row["comparator"], row["strategy"]): row for row in tir},
        "counts": statistics.summary(compared, means),
        "tir": dict.fromkeys(paper.MODES, np.nan) | means.set_index("mode")["mean"].to_dict(),
    }


def _warnings(alone: pd.DataFrame, contrasts: pd.DataFrame) -> Iterator[str]:
    """What makes this less than the paper's study."""
    patients = alone["patient"].nunique()
    shortest = float(alone["days"].min()) if "days" in alone else PAPER_DAYS
    if patients < PAPER_PATIENTS or shortest < PAPER_DAYS:
        yield (
            f"Less than the paper’s study: {patients} of its {PAPER_PATIENTS} patients, {shortest:g} of its "
            f"{PAPER_DAYS} days. Differences and intervals are not to be expected to agree."
        )
    absent = [mode.upper() for mode in paper.MODES if mode not in set(alone["mode"])]
    if absent:
        yield f"Not run: {', '.join(absent)}."
    touched = alone[alone["limiter_steps"] > 0] if "limiter_steps" in alone else alone.iloc[:0]
    if len(touched):
        yield (
            f"The firmware’s limits acted in {len(touched)} of {len(alone)} runs ({touched['limiter_steps'].sum():.0f} "
            "steps): the paper has none."
        )
    notes = contrasts.loc[contrasts["note"] != "", ["metric", "note"]]
    for note, rows in notes[~notes["note"].str.startswith("no runs of")].groupby("note"):
        metrics = ", ".join(figures.NAMES[metric] for metric in paper.CONTRAST_METRICS if metric in set(rows["metric"]))
        yield f"{note[0].upper()}{note[1:]}: {len(rows)} contrasts of {metrics}."


def _inconsistencies() -> pd.DataFrame:
    table = paper.inconsistencies()
    return pd.DataFrame(
        {
            "contrast": [f"{row.strategy.upper()} − {row.comparator.upper()}" for row in table.itertuples()],
            "metric": [figures.NAMES[metric] for metric in table["metric"]],
            "Table 3": table["difference"],
            "means of Table 2": [_number(value, 1) for value in table["of_means"]],
            "beyond rounding": table["excess"],
        }
    )


def _selections(runs: pd.DataFrame) -> list[dict[str, Any]]:
    rows = []
    for name, one in selection.selections(runs).items():
        published = "not stated"
        if name in paper.DOSES:
            published = f"{paper.chosen_dose(name):g} {paper.DOSES[name][2]}"
        rows.append(
            {"name": name, "label": one.label, "paper": published, "why": one.why, "candidates": one.candidates}
        )
    return rows


def _differing(
    contrasts: pd.DataFrame, cells: pd.DataFrame, explanations: Mapping[str, str]
) -> Iterator[dict[str, str]]:
    """Contrasts that disagree in sign or significance or lie outside the paper's interval, and cells off its mean.

    What was not run is not among them: the warnings on top name it.
    """
    odd = paper.inconsistencies().set_index(["comparator", "strategy", "metric"])["of_means"].to_dict()
    for row in contrasts[contrasts["difference"].notna()].to_dict("records"):
        hows = [] if row["agrees_sign"] else ["sign"]
        hows += [] if row["agrees_significance"] else ["significance"]
        hows += [] if row["inside_interval"] else ["outside the paper’s interval"]
        if not hows:
            continue
        if row["robust_agrees"] and not row["agrees"]:
            hows.append("agrees with the robust interval")
        metric, mode, comparator = row["metric"], row["strategy"], row["comparator"]
        why = [_explained(explanations, f"{comparator} {mode} {metric}", f"{mode} {metric}", metric)]
        if (comparator, mode, metric) in odd:
            why.append(f"The means of the paper’s Table 2 differ by {_number(odd[comparator, mode, metric], 1)} here.")
        yield {
            "what": f"S{mode[1]} − {comparator.upper()}",
            "metric": metric,
            "ours": f"{_number(row['difference'], 2)}{'*' if row['p'] < statistics.LEVEL else ''}",
            "theirs": f"{_number(row['paper_difference'], 2)}{'*' if row['paper_significant'] else ''}",
            "how": ", ".join(hows) if row["patients"] > 1 else "one patient",
            "why": " ".join(why).strip(),
        }
    for row in cells[~cells["agrees"]].to_dict("records"):
        yield {
            "what": f"mean of {row['mode'].upper()}",
            "metric": row["metric"],
            "ours": _number(row["mean"], 2),
            "theirs": _number(row["paper_mean"], 1),
            "how": "paper’s mean outside our interval" if row["patients"] > 1 else "one patient",
            "why": _explained(explanations, f"{row['mode']} {row['metric']}", row["metric"]),
        }


def _explained(explanations: Mapping[str, str], *keys: str) -> str:
    return next((explanations[key] for key in keys if key in explanations), "")


def _check_explanations(explanations: Mapping[str, str]) -> None:
    known = {*paper.TABLE2_METRICS}
    known |= {f"{mode} {metric}" for mode in paper.MODES for metric in paper.TABLE2_METRICS}
    known |= {f"{row.comparator} {row.strategy} {row.metric}" for row in paper.table3().itertuples()}
    for key in explanations:
        if key not in known:
            raise ValueError(f"explanations: {key!r} is no metric, mode and metric, or comparator, strategy and metric")

"""Fit the model of label errors to tables of ``label_tables.py``: ``make fit-labels``.

With ``--check`` nothing is fitted: the errors that the tables' maps foretell are compared with the true ones.
With ``--calibrate`` the trees stay, and the logits are fitted to drives that the trees never saw.

Drives are left out in turn (five folds by drive), for the calibration and for the figures that are printed:
log loss, expected and observed shares by bins of the predicted probability with intervals by bootstrap over
drives, and what is kept and wrong for bounds of the probability. The model that is stored is fitted to all.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold

from datagen.quality.label_error import BOUNDS_CM, Trees

FOLDS, SEED = 5, 0
#: Features with which an error can only become more, or less, likely.
MORE = ("rival", "offset_cm", "apart_cm", "shift_cm", "sigma_cm", "ahead_cm", "focal_cm", "pitch_cm",
        "bridged_cm", "one_border_cm", "width_off", "sideways_cm")  # fmt: skip
LESS = ("_met", "_both")
TREES = {"max_iter": 80, "learning_rate": 0.08, "max_leaf_nodes": 12, "min_samples_leaf": 150,
         "l2_regularization": 20.0, "max_features": 0.5, "random_state": SEED}  # fmt: skip
#: Bounds of the probabilities, of errors beyond 1 and 3 cm, whose price is printed.
TRIED = (
    (1.0, 1.0),
    (0.5, 0.02),
    (0.5, 0.05),
    (0.5, 0.03),
    (0.3, 0.05),
    (0.3, 0.03),
    (0.3, 0.02),
    (0.3, 0.01),
    (0.2, 0.01),
)
#: Errors below this are alike, [cm], and probabilities: a map stores four decimals.
LEAST_CM, LEAST_SHARE = 0.05, 5e-5


def read(folders: list[Path]) -> dict[str, np.ndarray]:
    """All tables below some folders, one row per label."""
    parts: dict[str, list[np.ndarray]] = {}
    paths = [path for folder in folders for path in sorted(folder.glob("*.npz"))]
    # A spoilt copy stays with its drive.
    drives = {str(path).split("_spoilt")[0].removesuffix(".npz") for path in paths}
    number = {name: k for k, name in enumerate(sorted(drives))}
    for path in paths:
        group = number[str(path).split("_spoilt")[0].removesuffix(".npz")]
        with np.load(path) as table:
            count = len(table["error_cm"])
            parts.setdefault("spoilt", []).append(np.full(count, bool(table["spoilt"])))
            for name in ("features", "error_cm", "withheld", "row", "off_1", "off_3"):
                parts.setdefault(name, []).append(table[name])
            parts.setdefault("drive", []).append(np.full(count, group))
            for name in ("trap", "camera", "verdict"):
                parts.setdefault(name, []).append(np.full(count, str(table[name])))
            names = table["names"]
    return {name: np.concatenate(values) for name, values in parts.items()} | {"names": names}


def monotone(names: list[str]) -> list[int]:
    """1 where a feature makes an error more likely, -1 where less, 0 where it may do either."""
    return [
        -1 if name.endswith(LESS) else 1 if any(name.endswith(end) for end in MORE) else 0 for name in names
    ]


def fit(target: str, features: np.ndarray, error_cm: np.ndarray, names: list[str]):  # type: ignore[no-untyped-def]
    """Fit one ensemble."""
    if target == "log_error":
        model = HistGradientBoostingRegressor(loss="absolute_error", monotonic_cst=monotone(names), **TREES)
        return model.fit(features, np.log(np.maximum(error_cm, LEAST_CM)))
    bound_cm = BOUNDS_CM[("off_1", "off_3").index(target)]
    model = HistGradientBoostingClassifier(monotonic_cst=monotone(names), early_stopping=False, **TREES)
    return model.fit(features, error_cm > bound_cm)


def raw(model, features: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Sum of the leaves, before the link."""
    return (
        model.decision_function(features) if hasattr(model, "decision_function") else model.predict(features)
    )


def stored(model, scale: np.ndarray) -> Trees:  # type: ignore[no-untyped-def]
    """The trees of a fitted ensemble as arrays; its first value is added to the intercept."""
    trees = [predictor[0].nodes for predictor in model._predictors]
    most = max(len(nodes) for nodes in trees)

    def column(name: str, dtype: type) -> np.ndarray:
        out: np.ndarray = np.zeros((len(trees), most), dtype)
        for row, nodes in zip(out, trees, strict=True):
            row[: len(nodes)] = nodes[name]
        return out

    leaf = column("is_leaf", bool)
    feature = np.where(leaf, -1, column("feature_idx", np.int16)).astype(np.int16)
    baseline = float(np.ravel(model._baseline_prediction)[0])
    # A feature of float32 is compared in float32.
    return Trees(
        feature, column("num_threshold", np.float64).astype(np.float32), column("missing_go_to_left", bool),
        column("left", np.int16), column("right", np.int16), column("value", np.float32),
        np.array([scale[0], scale[1] + scale[0] * baseline]),
    )  # fmt: skip


def bins_text(p: np.ndarray, wrong: np.ndarray, drive: np.ndarray) -> str:
    """Expected and observed shares by bins of the probability."""
    rng, lines = np.random.default_rng(SEED), []
    edges = [0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0]
    for low, high in pairwise(edges):
        inside = (p >= low) & (p < high)
        drives = np.unique(drive[inside])
        if not inside.any():
            continue
        sums = (
            np.array([(inside & (drive == d)).sum() for d in drives]),
            np.array([(inside & (drive == d) & wrong).sum() for d in drives]),
        )
        drawn = rng.integers(len(drives), size=(1000, len(drives)))
        share = sums[1][drawn].sum(axis=1) / np.maximum(sums[0][drawn].sum(axis=1), 1)
        few, many = np.percentile(share, [2.5, 97.5])
        lines.append(
            f"  {low:5.3f}..{high:5.3f}: {inside.sum():7d} labels of {len(drives):3d} drives, expected "
            f"{p[inside].mean():.4f}, observed {wrong[inside].mean():.4f} ({few:.4f}..{many:.4f})"
        )
    return "\n".join(lines)


def kept_text(p1: np.ndarray, p3: np.ndarray, table: dict[str, np.ndarray]) -> str:
    """What some bounds keep, and what of that is wrong."""
    size, drive = np.abs(table["error_cm"]), table["drive"]
    right, lines = size <= 1.0, []
    for most1, most3 in TRIED:
        kept = (p1 <= most1) & (p3 <= most3)
        shares = [(size[kept & (drive == d)] > 3.0).mean() for d in np.unique(drive[kept])]
        lines.append(
            f"  p1 <= {most1}, p3 <= {most3}: right kept {kept[right].mean():.3f}, kept {kept.mean():.3f}, "
            f"of them > 3 cm {(size[kept] > 3.0).mean():.4f} (expected {p3[kept].mean():.4f}), > 1 cm "
            f"{(size[kept] > 1.0).mean():.4f} (expected {p1[kept].mean():.4f}), worst drive {max(shares):.3f}"
        )
    today = ~table["withheld"]
    lines.append(
        f"  today's rules: right kept {today[right].mean():.3f}, kept {today.mean():.3f}, of them > 3 cm "
        f"{(size[today] > 3.0).mean():.4f}, > 1 cm {(size[today] > 1.0).mean():.4f}"
    )
    return "\n".join(lines)


def kinds_text(p1: np.ndarray, p3: np.ndarray, table: dict[str, np.ndarray]) -> str:
    """What some bounds keep, of all drives and by kind; spoilt copies do not count."""
    own, said = ~table["spoilt"], []
    for kind in ("all", *np.unique(table["trap"])):
        rows = own & ((table["trap"] == kind) | (kind == "all"))
        part = {name: values[rows] for name, values in table.items() if name != "names"}
        said.append(f"{kind}:\n{kept_text(p1[rows], p3[rows], part)}\n")
    return "".join(said)


def check(table: dict[str, np.ndarray]) -> str:
    """How often labels are off as often as their maps foretell."""
    known = np.isfinite(table["off_3"]) & ~table["spoilt"]
    said = f"{known.sum()} labels, {(~np.isfinite(table['off_3'])).sum()} not judged\n"
    for name, bound_cm in zip(("off_1", "off_3"), BOUNDS_CM, strict=True):
        wrong = np.abs(table["error_cm"][known]) > bound_cm
        said += f"{name}:\n{bins_text(table[name][known], wrong, table['drive'][known])}\n"
    return said + kinds_text(table["off_1"], table["off_3"], table)


def calibrated(path: Path, table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a stored model with the slopes and intercepts of its logits fitted to what the maps foretold."""
    with np.load(path) as model:
        columns = dict(model)
    for name, bound_cm in zip(("off_1", "off_3"), BOUNDS_CM, strict=True):
        known = np.isfinite(table[name]) & ~table["spoilt"]
        share = np.clip(table[name][known].astype(np.float64), LEAST_SHARE, 1.0 - LEAST_SHARE)
        logit, wrong = np.log(share / (1.0 - share)), np.abs(table["error_cm"][known]) > bound_cm
        line, drive, out = LogisticRegression(C=1e6), table["drive"][known], np.zeros(len(share))
        for train, test in GroupKFold(FOLDS).split(logit, groups=drive):
            out[test] = line.fit(logit[train, None], wrong[train]).predict_proba(logit[test, None])[:, 1]
        slope, intercept = float(line.fit(logit[:, None], wrong).coef_[0, 0]), float(line.intercept_[0])
        columns[f"{name}_scale"] = slope * columns[f"{name}_scale"] + np.array([0.0, intercept])
        sys.stdout.write(f"{name}: slope {slope:.3f}, {intercept:+.3f}\n{bins_text(out, wrong, drive)}\n")
    return columns


def main() -> None:
    """Fit, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="of label_tables.py")
    parser.add_argument("--out", type=Path, help="file of the model; nothing is written without it")
    parser.add_argument("--check", action="store_true", help="compare what maps foretell; fit nothing")
    parser.add_argument("--calibrate", type=Path, help="the model by which the maps were made")
    args = parser.parse_args()
    table = read(args.folders)
    if args.check:
        sys.stdout.write(check(table))
        return
    if args.calibrate is not None:
        columns = calibrated(args.calibrate, table)
        if args.out is not None:
            np.savez_compressed(args.out, allow_pickle=False, **columns)
        return
    names, features, size = table["names"].tolist(), table["features"], np.abs(table["error_cm"])
    drives, columns, found = table["drive"], {"names": np.array(names)}, {}
    # Spoilt copies teach what is wrong, but say nothing of how often that is.
    own = ~table["spoilt"]
    sys.stdout.write(f"{len(size)} labels of {len(np.unique(drives))} drives\n")
    for target in ("off_1", "off_3", "log_error"):
        out = np.zeros(len(size))
        for train, test in GroupKFold(FOLDS).split(features, groups=drives):
            out[test] = raw(fit(target, features[train], size[train], names), features[test])
        if target == "log_error":
            truth = np.log(np.maximum(size, LEAST_CM))
            scale = np.array([1.0, float(np.median((truth - out)[own]))])
            inside = [(size <= k * 1.4826 * np.exp(out + scale[1]))[own].mean() for k in (1.0, 2.0)]
            sys.stdout.write(f"{target}: one sigma holds {inside[0]:.3f}, two {inside[1]:.3f}\n")
        else:
            wrong = size > BOUNDS_CM[("off_1", "off_3").index(target)]
            line = LogisticRegression(C=1e6).fit(out[own, None], wrong[own])
            scale = np.array([line.coef_[0, 0], line.intercept_[0]])
            p = found[target] = 1.0 / (1.0 + np.exp(-scale[0] * out - scale[1]))
            share = wrong.mean()
            loss, flat = (
                -np.mean(np.where(wrong, np.log(q), np.log(1.0 - q)))
                for q in (np.clip(p, 1e-6, 1 - 1e-6), share)
            )
            sys.stdout.write(
                f"{target}: share {share:.4f}, log loss {loss:.4f} (constant {flat:.4f}), scale {scale}\n"
                f"{bins_text(p[own], wrong[own], drives[own])}\n"
            )
        trees = stored(fit(target, features, size, names), scale)
        columns |= {f"{target}_{part}": value for part, value in trees._asdict().items()}
    sys.stdout.write(kinds_text(found["off_1"], found["off_3"], table))
    if args.out is not None:
        np.savez_compressed(args.out, allow_pickle=False, **columns)
        sys.stdout.write(f"{args.out}: {args.out.stat().st_size / 1000:.0f} kB\n")


if __name__ == "__main__":
    main()

"""`pc2grid_lab.fit.posterior`, run as its users run it, on made answers whose model is known."""

import json
import os
import re
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from signature.localization.posterior import POSTERIOR, Evidence, masses

SCRIPT = Path(__file__).parents[3] / "tools" / "pc2grid_lab" / "fit" / "posterior.py"
TRUTH = replace(POSTERIOR, bias=-4.0, fit=2.0, lead=4.0)


def made(count: int, seed: int) -> list[tuple[Evidence, bool]]:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        evidence = Evidence(
            forward=float(rng.uniform(0.4, 0.99)),
            walls=float(rng.uniform(30, 300)),
            backward=float(rng.uniform(0.4, 0.99)),
            looked_at=float(rng.uniform(30, 300)),
            lead=float(rng.uniform(0.02, 0.15)),
            likeness=float(rng.uniform(0.0, 1.0)),
        )
        found.append((evidence, bool(rng.random() < masses([evidence], p=TRUTH)[0])))
    return found


def row(log: str, i: int, evidence: Evidence, error: list[float], **changes: Any) -> dict[str, Any]:
    """As `real_queries.py` writes it."""
    one = {
        "log": log,
        "map": log,
        "place": "in the map",
        "start": i // 4,
        "travel_m": 3.0,
        "window_m": 15.0,
        "stage": "proposed",
        "covered": 0.8,
        "evidence": [asdict(evidence)],
        "errors": [error],
    }
    return one | changes


def evidence_files(folder: Path) -> list[Path]:
    rows, trials = [], []
    for log, seed in (("a", 0), ("b", 1)):
        for i, (evidence, right) in enumerate(made(1500, seed)):
            rows.append(row(log, i, evidence, [0.1, 0.01] if right else [7.0, 0.0]))
    poor = Evidence(forward=0.4, walls=100.0, backward=0.4, looked_at=100.0, lead=0.01, likeness=0.5)
    rows += [
        row("a", 0, poor, [float("inf"), 3.0], map="b", place="elsewhere"),
        row("a", 0, poor, [9.0, 0.0], place="blanked"),
        row("a", 0, poor, [0.2, 0.0], place="blanked"),  # beside its place: neither right nor wrong
        row("a", 0, poor, [float("inf"), 3.0]),  # no true pose
    ]
    for i, (evidence, right) in enumerate(made(1500, 2)):
        trials.append(
            {
                "building": "c",
                "query_building": "c",
                "in_building": True,
                "query_sensor": "laser",
                "map_sensor": "lidar",
                "seed": i // 4,
                "travel_m": 10.0,
                "right": right,
                **{name: value for name, value in asdict(evidence).items() if name not in ("apart", "tail")},
            }
        )
    files = [folder / "real.json", folder / "sensors.json"]
    files[0].write_text(json.dumps(rows))
    files[1].write_text(json.dumps(trials))
    return files


def run(*files: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, files)]
    path = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (SCRIPT.parents[3], SCRIPT.parents[2])))}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=path)


def test_one_command_fits_and_judges(tmp_path: Path) -> None:
    done = run(*evidence_files(tmp_path))
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    fitted = {k: float(v) for k, v in re.findall(r"(\w+)=(-?[\d.]+)", lines[-1])}
    # 4500 answers of known probability: the parameters are found to a tenth or so.
    assert abs(fitted["fit"] - TRUTH.fit) < 0.4 and abs(fitted["lead"] - TRUTH.lead) < 0.8
    counts = {line[:50].strip(): line[50:].split()[:3] for line in lines[1:-3]}
    right = sum(is_right for seed in (0, 1) for _, is_right in made(1500, seed))
    assert counts["laser log in its own building"] == ["3", "3000", str(right)]
    assert counts["laser log in its own building, place blanked"] == ["3", "1", "0"]
    assert counts["laser log in another building"] == ["3", "1", "0"]
    assert counts["laser in a map by lidar"][1] == "1500"
    areas = [float(v) for v in re.findall(r"ROC curve ([\d.]+)", done.stdout)]
    assert len(areas) == 3 and 0.8 < areas[0] < areas[1] + 0.01  # fitted to them: no worse than in use


def test_old_evidence_and_a_single_building_are_refused(tmp_path: Path) -> None:
    real, sensors = evidence_files(tmp_path)
    alone = run(sensors)
    assert alone.returncode != 0 and "without c not both kinds" in alone.stderr
    rows = json.loads(real.read_text())[:3]
    for old in (
        [{k: v for k, v in one.items() if k != "place"} for one in rows],
        [one | {"evidence": [each | {"apart": 0.1} for each in one["evidence"]]} for one in rows],
    ):
        real.write_text(json.dumps(old))
        refused = run(real)
        assert refused.returncode != 0 and "real_queries.py" in refused.stderr


def test_a_scan_and_a_log_of_one_building_are_left_out_together(tmp_path: Path) -> None:
    real, sensors = evidence_files(tmp_path)
    log = {"log": "fr079", "map": "fr079"}
    rows = [one | log for one in json.loads(real.read_text()) if one["log"] == "b"]
    floor = {"building": "fr079_floor", "query_building": "fr079_floor"}
    trials = [one | floor for one in json.loads(sensors.read_text())]
    real.write_text(json.dumps(rows))
    sensors.write_text(json.dumps(trials))
    refused = run(real, sensors)
    assert refused.returncode != 0 and "without fr079 not both kinds" in refused.stderr

"""`pc2grid compare recordings`: every real recording as a map, and located in the maps of others."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from pc2grid.errors import ConfigError
from pc2grid_cli.console import Console
from pc2grid_cli.output import make_folder
from pc2grid_lab.commands import CompareRecordings
from pc2grid_lab.recordings.catalogue import Catalogue, own_recordings, state_of
from pc2grid_lab.recordings.judging import judged_table
from pc2grid_lab.recordings.run import Folder, followed_in, run_all
from pc2grid_lab.recordings.table import Table, change_lines, changes, markdown_page, show
from pc2grid_lab.runner import commit, digest_of_product, write_text


def compare_recordings(given: CompareRecordings, terminal: Console) -> None:
    """Map and locate what is not in the folder yet, judge all, and print the table and what changed."""
    data, out, only = given.data, given.out, given.only
    own = own_recordings(data, without=out, of_base=given.of_base)
    named = Catalogue.in_folder(data)
    recordings, pairs = [*named[0], *own[0]], [*named[1], *own[1]]
    if not recordings:
        raise ConfigError(f"{data}: holds no recording", hint="they end in .mcap, .bag or .db3")
    catalogue = Catalogue.of(recordings, pairs, only=only, quick=given.quick)
    work = out / "work" / (digest_of_product() + state_of(data, own[0]))
    make_folder(work)
    for other in work.parent.iterdir():  # of another version, whose results are not used again
        if other.name != work.name and other.is_dir():
            shutil.rmtree(other)
    folder = Folder(data.absolute(), work.absolute())
    followed = followed_in(catalogue, folder, only)
    if not (catalogue.mapped or catalogue.pairs or followed):
        raise ConfigError(f"--only {only}: no recording, building, sensor or kind is named so")
    kept = given.table or out / "real.json"
    before = _read(kept)
    try:
        with terminal.progress("recordings") as advance:
            run_all(catalogue, folder, followed=followed, jobs=given.jobs, advance=advance)
    except KeyboardInterrupt:
        terminal.note(f"what is done is kept in {out}; the same command goes on from there")
        raise
    with terminal.progress("judge") as advance:
        found = judged_table(
            catalogue, folder, followed, program=digest_of_product(), commit=commit(), advance=advance
        )
    changed = [] if before is None else changes(before, found)
    if only is None and not given.quick:
        write_text(kept, found.to_text())
        write_text(kept.with_suffix(".md"), markdown_page(found, changed))
    if given.page:
        print(markdown_page(found))
    else:
        show(found)
    if before is None:
        print(f"nothing to compare with: there is no {kept}")
    else:
        print(f"changed since {before.commit} ({kept}):", *(change_lines(changed) or ["- nothing"]), sep="\n")


def _read(file: Path) -> Table | None:
    """Return the table of an earlier run; None if there is none. Raises ConfigError if it cannot be read."""
    if not file.exists():
        return None
    try:
        return Table.from_json(json.loads(file.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file}: not a table of this command ({error})", hint="remove it, or name another by --table"
        ) from error

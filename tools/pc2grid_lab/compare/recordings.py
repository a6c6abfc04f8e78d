"""`pc2grid compare recordings`: every real recording as a map, and located in the maps of others."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

from pc2grid.errors import ConfigError
from pc2grid_cli import console
from pc2grid_cli.output_files import make_folder
from pc2grid_lab.experiments.program import commit, digest_of_product
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair, Recording
from pc2grid_lab.experiments.recordings.changes import changes
from pc2grid_lab.experiments.recordings.judging import judged_table
from pc2grid_lab.experiments.recordings.kidnaps import followed_in, tasks
from pc2grid_lab.experiments.recordings.own import own_recordings, state_of
from pc2grid_lab.experiments.recordings.page import change_lines, page
from pc2grid_lab.experiments.recordings.rows import Table
from pc2grid_lab.experiments.recordings.run import Folder, run_all
from pc2grid_lab.experiments.stored import write_text
from signature.config import ShortlistBy


def run(
    data: Path,
    out: Path,
    table: Path | None,
    terminal: console.Console,
    *,
    only: str | None,
    of_base: bool,
    quick: bool,
    shortlist: ShortlistBy,
    jobs: int,
) -> None:
    """Map and locate what is not in `out` yet, judge all, and print the table and what changed."""
    own = own_recordings(data, without=out, of_base=of_base)
    catalogue = _catalogue(data, own, only, quick)
    work = out / "work" / (digest_of_product() + state_of(data, own[0]))
    make_folder(work)
    _remove_others(work)
    folder = Folder(data.absolute(), work.absolute(), shortlist)
    is_control = shortlist != "signatures"
    followed = () if is_control else followed_in(catalogue, folder, only)
    if not (catalogue.mapped or catalogue.pairs or followed):
        raise ConfigError(f"--only {only}: no recording, building, sensor or kind is named so")
    with terminal.progress("recordings") as advance, _note_kept(terminal, out):
        mapped, further = tasks(catalogue, folder, followed)
        run_all(catalogue, folder, mapped=mapped, further=further, jobs=jobs, advance=advance)
    with terminal.progress("judge") as advance:
        found = judged_table(
            catalogue, folder, followed, program=digest_of_product(), commit=commit(), advance=advance
        )
    is_whole = only is None and not quick and not is_control
    _tell(found, table or out / "real.json", replace=is_whole)


def _tell(found: Table, kept: Path, *, replace: bool) -> None:
    """Print a table and what changed since the one that is kept. replace : whether it is then kept itself."""
    before = _read(kept)
    changed = [] if before is None else changes(before, found)
    if replace:
        write_text(kept, found.to_text())
        write_text(kept.with_suffix(".md"), page(found, changed))
    print(page(found))
    if before is None:
        print(f"nothing to compare with: there is no {kept}")
    else:
        print(f"changed since {before.commit} ({kept}):", *(change_lines(changed) or ["- nothing"]), sep="\n")


@contextlib.contextmanager
def _note_kept(terminal: console.Console, out: Path) -> Iterator[None]:
    """If the block is interrupted, print where its results are: they stay."""
    try:
        yield
    except KeyboardInterrupt:
        terminal.note(f"what is done is kept in {out}; the same command goes on from there")
        raise


def _catalogue(
    data: Path, own: tuple[list[Recording], list[Pair]], only: str | None, quick: bool
) -> Catalogue:
    """What is run: what the catalogue names, and one's own. Raises ConfigError if there is nothing."""
    named = Catalogue.in_folder(data)
    recordings, pairs = [*named[0], *own[0]], [*named[1], *own[1]]
    if not recordings:
        raise ConfigError(f"{data}: holds no recording", hint="they end in .mcap, .bag or .db3")
    return Catalogue.of(recordings, pairs, only=only, quick=quick)


def _read(file: Path) -> Table | None:
    """The table of an earlier run; None if there is none. Raises ConfigError if it cannot be read."""

    if not file.exists():
        return None
    try:
        return Table.from_json(json.loads(file.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file}: not a table of this command ({error})", hint="remove it, or name another by --table"
        ) from error


def _remove_others(work: Path) -> None:
    """Remove what other versions of the program made: their results are not used again."""
    for other in work.parent.iterdir():
        if other.name != work.name and other.is_dir():
            shutil.rmtree(other)

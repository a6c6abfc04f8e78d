"""Stretches of travel, and the places that a recognizer finds on them.

Loops that are farther off than the search near the tracked pose reaches are found by a `PlaceRecognizer`. It
is asked for stretches of a few local maps; what it finds waits among the `LoopCandidates`.
"""

from __future__ import annotations

import math

import numpy as np

from pc2grid.arrays import F64
from pc2grid.config import ProjectionConfig
from pc2grid.geometry import SE2
from pc2grid.mapping.keyframes import grid_of
from pc2grid.mapping.local_maps import LocalMaps
from pc2grid.mapping.loop_candidates import LoopCandidates
from pc2grid.mapping.place_recognition import PlaceRecognizer, Recognition, Stretch


class Stretches:
    """The stretches of a session that its recognizer was asked for.

    candidates : get what it finds. maps : consecutive local maps that make a stretch.
    recognizer : None: there are no stretches. projection : how the grids for the recognizer are drawn.
    """

    def __init__(
        self,
        local_maps: LocalMaps,
        candidates: LoopCandidates,
        maps: int,
        recognizer: PlaceRecognizer | None,
        projection: ProjectionConfig,
    ) -> None:
        self._local_maps, self._candidates, self._maps = local_maps, candidates, maps
        self._recognizer, self._projection = recognizer, projection
        self._asked: list[range] = []  # the local maps of each
        self._known_places: list[bool] = []  # whether each local map overlaps one of an earlier visit
        self._begin = 0  # first local map of the stretch that is not complete yet

    def extend(self, *, restart: bool, known: bool) -> bool:
        """Take the newest local map; returns whether it completes a stretch that the recognizer is asked for.

        restart : tracking was lost before it. known : it overlaps a local map of an earlier visit.

        A stretch does not reach across a lost part of the session: its map would be bent. Where all its local
        maps overlap those of an earlier visit already, there is nothing to ask and nothing new to remember.
        """
        if restart:
            self._begin = len(self._known_places)
        self._known_places.append(known)
        stretch = range(self._begin, len(self._known_places))
        if len(stretch) < self._maps:
            return False
        self._begin = stretch.stop
        return self._ask(stretch)

    def finish(self) -> bool:
        """The last local maps make a stretch that may overlap the one before; returns as `extend` does."""
        stop = len(self._known_places)
        return self._begin < stop and self._ask(range(max(stop - self._maps, 0), stop))

    def latest(self) -> range:
        """The local maps of the stretch that was asked for last."""
        return self._asked[-1]

    def accepted(self, nodes: F64, travel_m: F64) -> list[Recognition]:
        """What was recognised and is a loop, by drift and by each other; each is returned once.

        nodes : (N, 3) settled poses of the local maps. travel_m : (N,) metres of travel at each.
        """
        middles = [_middle(stretch) for stretch in self._asked]
        return self._candidates.take(nodes[middles], travel_m[middles])

    def guesses(self, found: Recognition) -> list[tuple[int, int, SE2]]:
        """The pairs of local maps of two stretches, the nearest first.

        Of each the older, the newer, and T_older_newer by the recognition.
        """
        pairs = []
        for older, T_stretch_older in self._within(self._asked[found.older]):
            for newer, T_stretch_newer in self._within(self._asked[found.newer]):
                # The last stretch overlaps the one before. Neighbours are matched by tracking already.
                if newer - older < 2:
                    continue
                guess = T_stretch_older.inverse() @ found.T_older_newer @ T_stretch_newer
                pairs.append((older, newer, guess))
        return sorted(pairs, key=lambda pair: (math.hypot(pair[2].x, pair[2].y), *pair[:2]))

    def _within(self, stretch: range) -> list[tuple[int, SE2]]:
        """The local maps of a stretch, and their tracked poses in its frame."""
        anchors = self._local_maps.anchors
        poses = self._local_maps.poses((anchors[number] for number in stretch), anchors[_middle(stretch)])
        return list(zip(stretch, poses, strict=True))

    def _ask(self, stretch: range) -> bool:
        """Ask where a stretch was seen before, unless all of its local maps are known."""
        if self._recognizer is None or all(self._known_places[k] for k in stretch):
            return False
        self._asked.append(stretch)
        self._candidates.add(self._recognizer.recognize(self._draw(len(self._asked) - 1, stretch)))
        return True

    def _draw(self, index: int, numbers: range) -> Stretch:
        """The stretch of some consecutive local maps, in the frame of the anchor of the middle one."""
        runs = self._local_maps.runs
        keyframes, poses = self._local_maps.keyframes(
            range(runs[numbers[0]].start, runs[numbers[-1]].stop), self._local_maps.anchors[_middle(numbers)]
        )
        return Stretch(
            index=index,
            grid=grid_of(zip(keyframes, poses, strict=True), self._projection),
            poses=np.array([(pose.x, pose.y, pose.yaw) for pose in poses]),
            scans=np.array([keyframe.index for keyframe in keyframes]),
        )


def _middle(numbers: range) -> int:
    """The local map whose frame a stretch is drawn in."""
    return numbers[len(numbers) // 2]

"""Bags of visual words: SIFT or SURF features, counted (BoW) or weighed by rarity (TF-IDF) (paper IV-A).

At most 300 features a submap, 1024 words. The words are learned from the submaps of the map itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, Submap

Feature = Callable[[NDArray[np.uint8]], F32]

MAX_FEATURES = 300
WORDS = 1024


def submap_image(submap: Submap) -> NDArray[np.uint8]:
    """The submap as the picture (H, W) it is published as: walls black, free white, unknown grey.

    Blurred by one cell, as a camera would: without it both features find the stairs that turning leaves in
    lines one cell wide, and recognise a third less.
    """
    image = np.full(submap.grid.cells.shape, 127, np.uint8)
    image[submap.grid.free] = 255
    image[submap.grid.occupied] = 0
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0))


def sift(image: NDArray[np.uint8]) -> F32:
    """Up to 300 SIFT descriptors (K, 128), the ones of strongest contrast; OpenCV's."""
    detector: Any = cv2.SIFT.create(nfeatures=MAX_FEATURES)
    _, descriptors = detector.detectAndCompute(image, None)
    # OpenCV keeps all that share the last place.
    return (
        np.empty((0, 128), np.float32)
        if descriptors is None
        else descriptors[:MAX_FEATURES].astype(np.float32)
    )


def surf(image: NDArray[np.uint8]) -> F32:
    """Up to 300 SURF descriptors (K, 64), the ones of strongest response."""
    from signature.baselines.surf import surf_descriptors

    return surf_descriptors(image, MAX_FEATURES)


FEATURES: dict[str, Feature] = {"sift": sift, "surf": surf}


@dataclass(slots=True)
class Vocabulary:
    """1024 words for one kind of feature, learned by k-means.

    Remembers the last map learned and the last submap read, so that methods which share a vocabulary do the
    work once.
    """

    feature: Feature
    seed: int = 0
    words: F32 = field(default_factory=lambda: np.empty((0, 0), np.float32))
    counts: F64 = field(default_factory=lambda: np.empty((0, 0)))
    _learned: Sequence[Submap] | None = None
    _read: Submap | None = None
    _count: F64 = field(default_factory=lambda: np.empty(0))

    def learn(self, submaps: Sequence[Submap]) -> F64:
        """Words of the submaps' features, and how often each occurs in each submap (N, words)."""
        if self._learned is submaps:
            return self.counts
        from sklearn.cluster import KMeans

        features = [self.feature(submap_image(submap)) for submap in submaps]
        everything = np.concatenate(features)
        size = min(WORDS, len(np.unique(everything, axis=0)))
        if size:
            # Ten rounds: a vocabulary has to be spread out, not converged.
            means = KMeans(size, init="random", n_init=1, max_iter=10, random_state=self.seed)
            self.words = means.fit(everything).cluster_centers_.astype(np.float32)
        else:
            self.words = np.empty((0, everything.shape[1]), np.float32)
        self.counts = np.array([self._spell(descriptors) for descriptors in features])
        self._learned, self._read = submaps, None
        return self.counts

    def read(self, submap: Submap) -> F64:
        """How often each word occurs in a submap, (words,)."""
        if self._read is not submap:
            self._count = self._spell(self.feature(submap_image(submap)))
            self._read = submap
        return self._count

    def _spell(self, descriptors: F32) -> F64:
        if len(self.words) == 0 or len(descriptors) == 0:
            return np.zeros(len(self.words))
        # |a - b|^2 without |a|^2, which is the same for every word.
        nearest = np.argmin((self.words**2).sum(axis=1) - 2 * descriptors @ self.words.T, axis=1)
        return np.bincount(nearest, minlength=len(self.words)).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Words:
    """Submaps compared by the cosine between their word counts.

    tfidf : weigh a word by how few submaps of the map have it.
    """

    vocabulary: Vocabulary
    tfidf: bool

    def fit(self, submaps: Sequence[Submap]) -> _Counts:
        """Learn the words and their weights from the submaps of a map."""
        counts = self.vocabulary.learn(submaps)
        weights = np.ones(counts.shape[1])
        if self.tfidf:
            from sklearn.feature_extraction.text import TfidfTransformer

            if counts.size:
                weights = TfidfTransformer(norm=None).fit(counts).idf_
        return _Counts(self.vocabulary, weights, _unit(counts * weights))


@dataclass(frozen=True, slots=True)
class _Counts:
    vocabulary: Vocabulary
    weights: F64
    table: F64

    def similarities(self, query: Submap) -> F64:
        return np.asarray(self.table @ _unit(self.vocabulary.read(query) * self.weights))


def _unit(rows: F64) -> F64:
    """Rows of length 1; a row of zeros stays one, and is alike to nothing."""
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(rows / np.where(lengths > 0, lengths, 1.0))

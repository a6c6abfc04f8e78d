"""Bags of visual words: SIFT or SURF features, counted (BoW) or weighted by rarity (TF-IDF) (paper IV-A).

At most 300 features a submap, 1024 words. The words are learned from the submaps of the map itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from sklearn.feature_extraction.text import TfidfTransformer

from pc2grid.arrays import F32, F64
from pc2grid.model import Submap
from pc2grid_lab.paper.rivals.surf import surf_descriptors

Feature = Callable[[NDArray[np.uint8]], F32]

MAX_FEATURES = 300
WORDS = 1024


def submap_image(submap: Submap) -> NDArray[np.uint8]:
    """The submap as an image (H, W) like the published maps: walls black, free cells white, unknown cells
    grey.

    The image is blurred by one cell. Without the blur both features respond to the steps in slanted lines
    of one cell, and recognise a third less.
    """
    image = np.full(submap.grid.cells.shape, 127, np.uint8)
    image[submap.grid.free] = 255
    image[submap.grid.occupied] = 0
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0))


def sift(image: NDArray[np.uint8]) -> F32:
    """Up to 300 SIFT descriptors (K, 128) of OpenCV, those of the strongest contrast."""
    detector: Any = cv2.SIFT.create(nfeatures=MAX_FEATURES)
    _, descriptors = detector.detectAndCompute(image, None)
    # OpenCV returns more than asked for if several have the contrast of the last.
    return (
        np.empty((0, 128), np.float32)
        if descriptors is None
        else descriptors[:MAX_FEATURES].astype(np.float32)
    )


def surf(image: NDArray[np.uint8]) -> F32:
    """Up to 300 SURF descriptors (K, 64), those of the strongest response."""
    return surf_descriptors(image, MAX_FEATURES)


@dataclass(slots=True)
class Vocabulary:
    """1024 words for one kind of feature, learned by k-means.

    The last map and the last submap are cached, so that methods which share a vocabulary extract features
    once.
    """

    feature: Feature
    seed: int = 0
    words: F32 = field(default_factory=lambda: np.empty((0, 0), np.float32))
    counts: F64 = field(default_factory=lambda: np.empty((0, 0)))
    _learned: Sequence[Submap] | None = None
    _read: Submap | None = None
    _count: F64 = field(default_factory=lambda: np.empty(0))

    def learn(self, submaps: Sequence[Submap]) -> F64:
        """Learn the words from the features of N submaps; counts of each word in each submap (N, words)."""
        if self._learned is submaps:
            return self.counts
        features = [self.feature(submap_image(submap)) for submap in submaps]
        everything = np.concatenate(features)
        size = min(WORDS, len(np.unique(everything, axis=0)))
        if size:
            # Ten iterations: the words need to be spread over the features, not to have converged.
            means = KMeans(size, init="random", n_init=1, max_iter=10, random_state=self.seed)
            self.words = means.fit(everything).cluster_centers_.astype(np.float32)
        else:
            self.words = np.empty((0, everything.shape[1]), np.float32)
        self.counts = np.array([self._word_counts(descriptors) for descriptors in features])
        self._learned, self._read = submaps, None
        return self.counts

    def read(self, submap: Submap) -> F64:
        """Counts of each word in a submap, (words,)."""
        if self._read is not submap:
            self._count = self._word_counts(self.feature(submap_image(submap)))
            self._read = submap
        return self._count

    def _word_counts(self, descriptors: F32) -> F64:
        if len(self.words) == 0 or len(descriptors) == 0:
            return np.zeros(len(self.words))
        # |a - b|^2 without |a|^2, which is the same for all words b.
        nearest = np.argmin((self.words**2).sum(axis=1) - 2 * descriptors @ self.words.T, axis=1)
        return np.bincount(nearest, minlength=len(self.words)).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Words:
    """Submaps compared by the cosine between their word counts.

    tfidf : weight a word by its inverse document frequency, which is larger the fewer submaps contain it.
    """

    vocabulary: Vocabulary
    tfidf: bool

    def fit(self, submaps: Sequence[Submap]) -> _Counts:
        """Learn the words and their weights from the submaps of a map."""
        counts = self.vocabulary.learn(submaps)
        weights = np.ones(counts.shape[1])
        if self.tfidf and counts.size:
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
    """Rows scaled to length 1; a row of zeros stays zero, and its similarity to all others is 0."""
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(rows / np.where(lengths > 0, lengths, 1.0))

"""Chains of net elements with one coordinate that lead from one place to another, or on from one."""

from __future__ import annotations

import numpy as np

from pipeline.stages.track.chain import Chain, search
from pipeline.stages.track.network import Edge, Network
from pipeline.stages.track.path import Place


def chains_between(
    network: Network, start: int, begin: Place, goal: Place, lengths_m: tuple[float, float], back: bool, most: int
) -> list[Chain] | None:
    """Chains from `begin` on the oriented element `start` to `goal`, of a length between the two; `begin` is at 0.

    `back`: the train runs them from the goal to the begin. None where there are more than `most`.
    """
    shortest_m, longest_m = lengths_m
    first = Chain((start,), (-network.track.along_m(start, begin.measure_m),))

    def onward(chain: Chain) -> list[Edge]:
        edges = network.successors[chain.oriented[-1]]
        return [edge for edge in edges if (edge.backward if back else edge.forward)]

    chains: list[Chain] = []
    for steps, found in enumerate(search(network, first, longest_m, onward), 1):
        last = found.chain.oriented[-1]
        if last // 2 == goal.element:
            at_m = found.distance_m + network.track.along_m(last, goal.measure_m)
            if shortest_m <= at_m <= longest_m:
                chains.append(found.chain)
        if len(chains) > most or steps > most**2:
            return None
    return chains


def extended(network: Network, chain: Chain, least_m: float, most_m: float, most: int) -> list[Chain] | None:
    """The chain carried on over every branch until it covers the coordinates from `least_m` to `most_m`.

    Where the track ends before, it ends. None where there are more than `most` chains.
    """
    done: list[Chain] = []
    for ahead in _whole(network, chain, most_m, most):
        done += [whole.turned(network) for whole in _whole(network, ahead.turned(network), -least_m, most)]
        if len(done) > most:
            return None
    return done or None


def _whole(network: Network, chain: Chain, until_m: float, most: int) -> list[Chain]:
    """The chain carried on over every branch up to a coordinate, or the end of the track; none where too many."""

    def onward(chain: Chain) -> list[Edge]:
        edges = network.successors[chain.oriented[-1]] if chain.exit_m(network) < until_m else ()
        return [edge for edge in edges if edge.forward or edge.backward]

    whole: list[Chain] = []
    number = 1
    for found in search(network, chain, np.inf, onward):
        branches = len(onward(found.chain))
        whole += [] if branches else [found.chain]
        number += max(branches - 1, 0)
        if number > most:
            return []
    return whole

"""Chains of net elements with one coordinate that lead from one place to another, or on from one."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.stages.track.chain import Chain
from pipeline.stages.track.network import Edge, Network
from pipeline.stages.track.path import Place


def chains_between(
    network: Network, start: int, begin: Place, goal: Place, lengths_m: tuple[float, float], back: bool, most: int
) -> list[Chain] | None:
    """Chains from `begin` on the oriented element `start` to `goal`, of a length between the two; `begin` is at 0.

    `back`: the train runs them from the goal to the begin. None where there are more than `most`.
    """
    shortest_m, longest_m = lengths_m
    chains: list[Chain] = []
    open_chains = [Chain((start,), (-network.track.along_m(start, begin.measure_m),))]
    steps = 0
    while open_chains:
        chain = open_chains.pop()
        last = chain.oriented[-1]
        entry_m = chain.entry_m[-1]
        if last // 2 == goal.element:
            at_m = entry_m + network.track.along_m(last, goal.measure_m)
            if shortest_m <= at_m <= longest_m:
                chains.append(chain)
        exit_m = entry_m + network.length_m(last)
        steps += 1
        if len(chains) > most or steps > most**2:
            return None
        open_chains += [
            Chain((*chain.oriented, edge.to), (*chain.entry_m, exit_m + edge.gap_m))
            for edge in network.successors[last]
            if exit_m + edge.gap_m <= longest_m and (edge.backward if back else edge.forward)
        ]
    return chains


def extended(network: Network, chain: Chain, least_m: float, most_m: float, most: int) -> list[Chain] | None:
    """The chain carried on over every branch until it covers the coordinates from `least_m` to `most_m`.

    Where the track ends before, it ends. None where there are more than `most` chains.
    """
    done: list[Chain] = []
    growing = [chain]
    while growing:
        chain = growing.pop()
        further = _onward(network, chain, most_m) or _before(network, chain, least_m)
        growing += further
        done += [] if further else [chain]
        if len(done) + len(growing) > most:
            return None
    return done


def _onward(network: Network, chain: Chain, until_m: float) -> list[Chain]:
    exit_m = chain.entry_m[-1] + network.length_m(chain.oriented[-1])
    edges = _runnable(network.successors[chain.oriented[-1]]) if exit_m < until_m else []
    return [Chain((*chain.oriented, edge.to), (*chain.entry_m, exit_m + edge.gap_m)) for edge in edges]


def _before(network: Network, chain: Chain, until_m: float) -> list[Chain]:
    entry_m = chain.entry_m[0]
    edges = _runnable(network.successors[chain.oriented[0] ^ 1]) if entry_m > until_m else []
    return [
        Chain((edge.to ^ 1, *chain.oriented), (entry_m - edge.gap_m - network.length_m(edge.to), *chain.entry_m))
        for edge in edges
    ]


def _runnable(edges: Sequence[Edge]) -> list[Edge]:
    return [edge for edge in edges if edge.forward or edge.backward]

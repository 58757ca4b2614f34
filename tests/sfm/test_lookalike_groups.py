from itertools import combinations

import networkx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wildgs.sfm.lookalike_groups import LEAST_AGAINST, LEAST_RATIO, find_contradicted_group
from wildgs.sfm.lookalikes import JudgedPair


def clique(letters: str, matches: int = 80) -> list[JudgedPair]:
    return [JudgedPair((a, b), matches, agrees=True) for a, b in combinations(letters, 2)]


def between(first: str, second: str, matches: int, *, agrees: bool) -> list[JudgedPair]:
    return [JudgedPair((a, b), matches, agrees) for a in first for b in second]


def test_a_group_is_found_that_one_pair_joins_and_others_contradict() -> None:
    """Each photo of it agrees with more matches than contradict it."""
    pairs = clique("abcdefg") + clique("xyz") + between("a", "x", 40, agrees=True)
    against = between("bcd", "xyz", 20, agrees=False)
    group = find_contradicted_group(pairs + against)
    assert group is not None
    assert group.photos == set("xyz"), "the smaller part"
    assert (group.against, group.supported, group.ratio) == (180, 40, 4.5)
    for name in "xyz":
        own = [pair for pair in pairs + against if name in pair.photos]
        assert sum(p.matches for p in own if p.agrees) > sum(p.matches for p in own if not p.agrees)


@pytest.mark.parametrize("supported", [60, 100])
def test_agreeing_matches_outweigh_contradicting_ones(supported: int) -> None:
    pairs = clique("abcdef") + clique("xyz") + between("a", "x", supported, agrees=True)
    group = find_contradicted_group(pairs + between("b", "xyz", 60, agrees=False))
    assert (group is None) == (LEAST_RATIO * supported >= 180)


@pytest.mark.parametrize("matches", [LEAST_AGAINST // 4 - 1, LEAST_AGAINST // 4])
def test_few_matches_are_not_enough(matches: int) -> None:
    pairs = clique("abcdef") + clique("xy") + between("a", "x", 15, agrees=True)
    group = find_contradicted_group(pairs + between("bc", "xy", matches, agrees=False))
    assert (group is None) == (4 * matches < LEAST_AGAINST)


def test_a_group_that_no_pair_supports_is_found() -> None:
    """Its photos were registered by points that they share with many photos, none of which is a pair."""
    pairs = clique("abcdef") + clique("xy") + between("ab", "xy", 30, agrees=False)
    group = find_contradicted_group(pairs)
    assert group is not None
    assert group.photos == set("xy")
    assert group.supported == 0


def test_no_pairs_no_group() -> None:
    assert find_contradicted_group([]) is None
    assert find_contradicted_group(clique("abcdef")) is None


@st.composite
def collections(draw: st.DrawFn) -> list[JudgedPair]:
    """Pairs of up to eight photos whose numbers of matches differ, so that there is one spanning tree."""
    photos = draw(st.integers(2, 8))
    possible = list(combinations("abcdefgh"[:photos], 2))
    chosen = draw(st.lists(st.sampled_from(possible), unique=True, min_size=1))
    counts = draw(st.permutations(range(20, 20 + 10 * len(chosen), 10)))
    agrees = draw(st.lists(st.booleans(), min_size=len(chosen), max_size=len(chosen)))
    return [JudgedPair(*row) for row in zip(chosen, counts, agrees, strict=True)]


@given(collections())
def test_no_part_of_the_tree_of_networkx_is_contradicted_more(pairs: list[JudgedPair]) -> None:
    graph = networkx.Graph()
    for pair in pairs:
        graph.add_edge(*pair.photos, weight=pair.matches + 1000 * pair.agrees)
    tree = networkx.maximum_spanning_tree(graph)
    worst = 0.0
    for edge in list(tree.edges):
        tree.remove_edge(*edge)
        part = networkx.node_connected_component(tree, edge[0])
        tree.add_edge(*edge)
        crossing = [pair for pair in pairs if len(part & set(pair.photos)) == 1]
        against = sum(pair.matches for pair in crossing if not pair.agrees)
        supported = sum(pair.matches for pair in crossing if pair.agrees)
        if against >= LEAST_AGAINST:
            worst = max(worst, against / max(supported, 1))
    group = find_contradicted_group(pairs)
    if group is None:
        assert worst <= LEAST_RATIO
        return
    assert group.ratio == worst > LEAST_RATIO
    component = networkx.node_connected_component(graph, min(group.photos))
    assert group.photos < component
    assert 2 * len(group.photos) <= len(component)

"""The user study: its game, its protocol, its simulated people, its statistics."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from tutelage.errors import ConfigError, ContractError
from tutelage.experiments import table_3_2
from tutelage.experiments.reproduction import reproduce
from tutelage.experiments.table_3_2 import PUBLISHED, Table32Config, condition, one, sign_flip_test, table
from tutelage.experiments.user_study.concentration import Concentration, Table
from tutelage.experiments.user_study.player import Player, PlayerConfig
from tutelage.experiments.user_study.protocol import CONDITIONS, HUMAN_GATED, ROBOTS, order

# -- the game ---------------------------------------------------------------------------------------------------------


@given(cards=st.integers(1, 12).map(lambda n: 2 * n), seed=st.integers(0, 99), data=st.data())
def test_a_game_shows_what_was_turned_over_and_ends_with_all_pairs(cards: int, seed: int, data: st.DataObject) -> None:
    game = Concentration(cards, default_rng(seed))
    pictures: dict[int, int] = {}
    for _ in range(data.draw(st.integers(0, 60))):
        if game.over:
            break
        up = game.face_up
        turned = game.turn(data.draw(st.sampled_from(game.face_down)))
        assert pictures.setdefault(turned.card, turned.picture) == turned.picture
        assert (turned.pair is None) == (len(up) % 2 == 0)
        assert set(game.face_up) | set(game.face_down) == set(range(cards))
        assert not set(game.face_up) & set(game.face_down)
        assert all(pictures[card] == picture for card, picture in game.face_up.items())
        found = Counter(game.face_up.values())
        assert game.pairs == sum(n == 2 for n in found.values())
    assert game.over == (game.pairs == cards // 2)


def test_each_picture_is_on_two_cards_anywhere() -> None:
    def layout(seed: int) -> tuple[int, ...]:
        game = Concentration(24, default_rng(seed))
        return tuple(game.turn(card).picture for card in [*range(0, 24, 2)])

    pictures = [Concentration(24, default_rng(seed))._pictures for seed in range(20)]
    assert all(Counter(p.tolist()) == Counter(dict.fromkeys(range(12), 2)) for p in pictures)
    assert len({tuple(p) for p in pictures}) == 20


@pytest.mark.parametrize("card", [-1, 24, 3])
def test_a_card_that_cannot_be_turned_over_is_refused(card: int) -> None:
    game = Concentration(24, default_rng(0))
    game.turn(3)
    with pytest.raises(ContractError, match=f"card {card} cannot be turned over"):
        game.turn(card)


@pytest.mark.parametrize("cards", [-2, 0, 1, 13])
def test_a_game_has_an_even_number_of_cards(cards: int) -> None:
    with pytest.raises(ConfigError, match="an even number of cards"):
        Concentration(cards, default_rng(0))


def test_a_finished_game_is_followed_by_a_new_one_and_all_pairs_count() -> None:
    games = Table(4, default_rng(0))
    for expected in range(1, 9):
        card = games.game.face_down[0]
        partner = np.flatnonzero(games.game._pictures == games.game._pictures[card])
        games.turn(int(partner[0]))
        games.turn(int(partner[1]))
        assert games.pairs == expected


# -- the player -------------------------------------------------------------------------------------------------------


def found(config: PlayerConfig, calls: int = 0, seeds: int = 40, steps: int = 240) -> float:
    """Pairs on average, when called away every `calls` timesteps."""
    pairs = []
    for seed in range(seeds):
        games = Table(24, default_rng(seed))
        player = Player(games, config, default_rng(1000 + seed))
        for t in range(steps):
            if calls and t % calls == 0:
                player.called()
            else:
                player.free()
        pairs.append(games.pairs)
    return float(np.mean(pairs))


def test_a_perfect_memory_needs_the_turns_that_are_known_for_it() -> None:
    """Velleman and Warrington (2013): optimal play with n pairs takes about 1.614 n turns; ours never passes, so a little more."""
    assert 12 * found(PlayerConfig(pace=1, memory=24), steps=240) / 240 == pytest.approx(12 / 1.614, rel=0.1)


def test_more_memory_finds_more_and_interruptions_cost_pairs() -> None:
    assert found(PlayerConfig(memory=2)) < found(PlayerConfig(memory=5)) < found(PlayerConfig(memory=12))
    assert found(PlayerConfig(), calls=10) < found(PlayerConfig(), calls=40) < found(PlayerConfig())


@pytest.mark.parametrize("bad", [{"pace": 0}, {"memory": 0}, {"forget": 1.5}])
def test_impossible_players_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="a player needs"):
        PlayerConfig(**bad)


# -- the protocol -----------------------------------------------------------------------------------------------------


def test_each_participant_has_all_conditions_in_an_order_of_their_own() -> None:
    orders = [order(k) for k in range(200)]
    assert all(sorted(o) == sorted(CONDITIONS) for o in orders)
    assert len(set(orders)) == 24, "every order occurs"
    assert orders == [order(k) for k in range(200)]


@pytest.mark.parametrize("algorithm", CONDITIONS)
def test_every_timestep_of_every_robot_is_somebodys(algorithm: str) -> None:
    config = condition(algorithm, 100, 2)
    quick = dataclasses.replace(config, steps=60, calibration_steps=200, members=2, hidden=(16,), threads=1,
                                learner=dataclasses.replace(config.learner, pretrain=50),
                                critic=dataclasses.replace(config.critic, pretrain=20, hidden=(16,)))  # fmt: skip
    result = one(quick, PlayerConfig())
    counts = result["counts"]
    gated = algorithm != HUMAN_GATED
    assert (counts["pairs"] is None, counts["idle_time"] is None) == (not gated, not gated)
    known = counts["human_actions"] + counts["robot_actions"] + (ROBOTS * counts["idle_time"] if gated else 0)
    assert known <= 60 * ROBOTS + 1e-6
    if gated:
        assert known >= 60 * ROBOTS - 60, "what is missing are hard resets, by the one person"
    json.dumps(result)


# -- the table --------------------------------------------------------------------------------------------------------


def result(algorithm: str, seed: int, value: float) -> dict[str, object]:
    counts = dict.fromkeys(table_3_2.COLUMNS, value) | (
        {"pairs": None, "idle_time": None} if algorithm == HUMAN_GATED else {}
    )
    return {"algorithm": algorithm, "seed": seed, "counts": counts}


def test_the_table_has_published_and_ours_and_pairs_people_with_themselves() -> None:
    results = [result(a, s, 10 * k + s) for k, a in enumerate(PUBLISHED) for s in range(5)]
    text = table(results)
    assert "| ThriftyDAgger | published | 7.9 ± 2.1 | 179.4 ± 34.9 |" in text
    assert "| | ours | 32.0 ± 1.6 |" in text
    assert "| SafeDAgger | +20.0 (p = 0.062)" in text
    assert text.count("| – |") >= 1


@given(values=st.lists(st.integers(-5, 5), min_size=1, max_size=7))
def test_the_test_is_that_of_all_sign_changes(values: list[int]) -> None:
    total = abs(sum(values))
    flips = [
        abs(sum(s * v for s, v in zip(signs, values, strict=True)))
        for signs in itertools.product((1, -1), repeat=len(values))
    ]
    assert sign_flip_test(np.array(values, dtype=float)) == pytest.approx(np.mean([f >= total for f in flips]))


def test_reproduce_runs_the_conditions_in_the_participants_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen = []

    def run_jobs(jobs, workers):  # type: ignore[no-untyped-def]
        seen.extend(job.title for job in jobs)
        return [result(job.arguments[0].algorithm, job.arguments[0].seed, 1.0) for job in jobs]

    monkeypatch.setattr(table_3_2, "run_jobs", run_jobs)
    text = reproduce("table-3.2", (), (3, 4), False, 2, tmp_path, tmp_path / "results")
    assert seen == [f"participant {p}: {a}" for p in (3, 4) for a in order(p)]
    assert "2 simulated participants" in text
    with pytest.raises(ConfigError, match="leave out --tasks"):
        reproduce("table-3.2", ("Ant",), (), False, 2, tmp_path, tmp_path)


def test_impossible_studies_are_refused() -> None:
    for bad in ({"seeds": ()}, {"workers": 0}, {"latency": -1}):
        with pytest.raises(ConfigError, match="table-3.2 needs"):
            Table32Config(**bad)

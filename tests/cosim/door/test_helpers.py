"""Helpers for authors of extensions: results by keyword, random numbers of names, and kinds told from methods."""

import numpy as np
import pytest

from cosim.door.blame import ExtensionError, Refused
from cosim.door.guard import Guarded, make
from cosim.door.load import load_own
from cosim.extend import MessageRound, Messages, Outcome, Stations, TrustScores, draws
from cosim.runs.run import pseudonym_remarks
from tests.cosim.door.test_mistakes import GOOD, source
from tests.cosim.door.tiny import SCENES


def test_trust_scores_in_any_order():
    scores = TrustScores.of(
        7, np.array([0, 0, 2]), np.array([5, 3, 1]), np.array([0.5, 0.3, 0.1]), newest_step=np.array([5, 3, 1])
    )
    assert scores.step == 7 and scores.subject.tolist() == [3, 5, 1] and scores.holder.tolist() == [0, 0, 2]
    assert scores.trust.tolist() == [0.3, 0.5, 0.1] and scores.newest_step.tolist() == [3, 5, 1]
    assert scores.oldest_evaluation_step.tolist() == [-1, -1, -1] and scores.weight.tolist() == [1, 1, 1]
    assert np.isnan(scores.uncertainty).all() and scores.is_evaluated.all() and scores.n_evaluators is None


def test_a_message_round_from_receivers_and_messages():
    # Stations at 0, 30 and 70 m; the first and the last send. Station 1 receives both, station 0 loses the last one's.
    stations = Stations(np.arange(3, dtype=np.uint64), np.array([[0.0, 0, 2], [30, 0, 2], [70, 0, 2]]), 3)
    messages = Messages(np.array([0, 1, 2]), np.array([300, 0, 200]), np.array([0.0, 0.0, 0.1]))
    happened = MessageRound.of(
        stations, messages, np.array([1, 1]), np.array([2, 0]), latency_s=np.array([0.02, 0.01]),
        lost_receiver=np.array([0]), lost_message=np.array([2]),
    )  # fmt: skip
    got, frames = happened.receptions, happened.frames
    assert got.receiver.tolist() == [1, 1] and got.message.tolist() == [0, 2] and got.distance_m.tolist() == [30, 40]
    np.testing.assert_allclose(got.received_s, [0.01, 0.12])
    assert frames.outcome.tolist() == [Outcome.RECEIVED, Outcome.RECEIVED, Outcome.PROPAGATION]
    assert frames.distance_m.tolist() == [40, 30, 70] and frames.n_transmissions.tolist() == [1, 0, 1]
    assert frames.sent_bytes == 500


def test_draws_depend_on_names_alone():
    names, others = np.array([5, 900, 3], np.uint64), np.array([1, 2, 3])
    all_rows = draws(4, 10, (names, others), 2)
    assert all_rows.shape == (3, 2) and (all_rows >= 0).all() and (all_rows < 1).all()
    assert np.array_equal(draws(4, 10, (names[::-1], others[::-1]), 2), all_rows[::-1])
    assert np.array_equal(draws(4, 10, (names[1:2], others[1:2]))[:, 0], all_rows[1:2, 0])
    assert not np.intersect1d(all_rows, [draws(4, 11, (names, others), 2), draws(5, 10, (names, others), 2)]).size


def test_draws_of_a_detector_depend_on_the_pair_alone():
    _, seen, _, _, keys = SCENES["detector"]()["detect"]
    u = keys.uniforms(seen, 3)
    assert u.shape == (6, 3) and len(np.unique(u)) == 18
    assert np.array_equal(keys.uniforms(seen.take(np.array([4, 2])), 3), u[[4, 2]])


@pytest.mark.parametrize("kind", GOOD)
def test_the_kind_is_told_from_the_methods(tmp_path, kind):
    (tmp_path / "mine.py").write_text(source(GOOD[kind]))
    assert load_own(f"{tmp_path}/mine.py:Mine").kind.name == kind


def test_no_kind_or_two(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("class Mine:\n    def change(self, ages): pass\n")
    with pytest.raises(Refused, match=r"methods of no kind of extension. change\(\): Did you mean changes\?"):
        load_own(f"{path}:Mine")
    path.write_text(source(GOOD["policy"] + "\n" + GOOD["driver"]))
    with pytest.raises(Refused, match="several kinds: pseudonym policy, driver"):
        load_own(f"{path}:Mine")


def test_what_was_returned_stays_as_it_was(tmp_path):
    """A class that keeps an array that it returned, and changes it in the next step, changes nothing recorded."""
    path = tmp_path / "mine.py"
    path.write_text(
        "import numpy as np\nclass Mine:\n    kept = np.zeros(6, bool)\n    def changes(self, ages):\n"
        "        self.kept[:] = ~self.kept\n        return self.kept\n"
    )
    mine, (ages,) = make(load_own(f"{path}:Mine")), SCENES["policy"]()["changes"]
    first = mine.changes(ages)
    assert first.all() and not mine.changes(ages).any() and first.all()


@pytest.mark.parametrize("returned", ["np.full(3, -0.1)", "np.ones(1)", "None", "np.full(3, np.nan)"])
@pytest.mark.parametrize("hook, given", [
    ("position_sigma_m", "n_points, label, range_m"), ("heading_sigma_rad", "n_points, label, range_m"),
    ("size_sigma", "n_points, label, range_m"), ("error_by_score", "score, n_points, label"),
])  # fmt: skip
def test_the_accuracy_of_a_detector_is_checked(tmp_path, returned, hook, given):
    """A negative deviation, one number for three objects, nothing, and no numbers."""
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n\n\nclass Mine:\n"
        "    def detect(self, sweeps, seen, boxes, label, draws):\n        pass\n\n"
        f"    def {hook}(self, {given}):\n        return {returned}\n"
    )
    mine, label = make(load_own(f"{file}:Mine")), np.zeros(3, np.uint8)
    values = {"n_points": np.array([1, 20, 300]), "label": label, "range_m": np.ones(3), "score": np.full(3, 0.5)}
    with pytest.raises(ExtensionError, match=hook):
        getattr(mine, hook)(*(values[name] for name in given.split(", ")))


def test_a_signal_passes(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("class Mine:\n    def changes(self, ages):\n        raise KeyboardInterrupt\n")
    with pytest.raises(KeyboardInterrupt):
        make(load_own(f"{path}:Mine")).changes(*SCENES["policy"]()["changes"])


def test_a_value_of_the_future_where_no_argument_says_the_step(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(source(GOOD["trust"]))
    choice, scene = load_own(f"{path}:Mine"), SCENES["trust"]()
    inside = choice.of()
    inside.open_step(*scene["open_step"])
    assert Guarded(choice, inside, latest_step=5).scores(None).step == 5
    with pytest.raises(ExtensionError, match="step = 5, but the step of the call, 4, is expected"):
        Guarded(choice, inside, latest_step=4).scores(None)


def test_short_lived_pseudonyms_are_remarked_on():
    (said,) = pseudonym_remarks({"messages_per_pseudonym": 1.0})
    assert said.startswith("note: vehicles sent 1 messages under each pseudonym") and "pseudonyms.linkage" in said
    assert pseudonym_remarks({}) == []

"""Trust as a classifier of vehicles, by hand."""

import numpy as np
import pytest

from cosim.addons.security import security
from results.metrics import misbehaviour
from tests.results.test_misbehaviour import attacking, open_run_without, values


def test_suspicion_needs_evaluations(tiny):
    """At steps 4, 8 and 12: honest 0.3 on 5 evaluations, 0.1 on 19, 0.6 on 90; attacker 0.4 on 19, 20 and 40.

    From 20 evaluations on, only the attacker is suspected, twice of three times, first 5 s after its attack. The mean
    of 0.2 and 0.6, on 10 and 30 evaluations, has as many as suspicion needs.
    """
    seen = {4: ((0.3, 5), (0.4, 19)), 8: ((0.1, 19), (0.4, 20)), 12: ((0.6, 90), (0.4, 40))}
    ledger = [
        {"step": s, "subject": v, "trust": t, "n_evaluations": n}
        for s, both in seen.items() for v, (t, n) in enumerate(both)
    ]  # fmt: skip
    vehicles, trust = attacking(["honest", "malicious"], {1: 3}), {"suspect_below": 0.5}
    for least, precision, recall, honest in ((20, 1, 2 / 3, False), (1, 3 / 5, 1, True)):
        run = tiny(20, config={"trust": trust | {"suspect_from": least}}, vehicles=vehicles, trust=ledger)
        by_value = security.confusion(run).set_index("unit").loc["value"]
        assert (by_value.precision, by_value.recall) == pytest.approx((precision, recall))
        delay = misbehaviour.detection_delay(run).set_index("subject")
        assert delay.found.to_dict() == {0: honest, 1: True}
        assert delay.delay_s[1] == (5 if least == 20 else 1)
        assert security.false_exclusions(run).value == 0  # from 1 on, it is excluded at the first moment already
    looked = [
        {"step": 4, "receiver": r, "subject": 1, "trust": t, "source": "own", "n_evaluations": n}
        for r, t, n in ((0, 0.2, 10), (2, 0.6, 30))
    ]
    config = {"trust": trust | {"suspect_from": 20}}
    vehicles = attacking(["honest", "malicious", "honest"], {1: 3})
    run = tiny(20, config=config, vehicles=vehicles, trust_lookups=looked)
    assert security.excluded(run).query("subject == 1").excluded.all()
    assert misbehaviour.at_lookup(run).set_index("role").suspected["malicious"] == 0


def test_confusion_by_hand(town):
    """Below 0.35 and rated: attackers' 0.3, 0.1, 0.3 of 5, honest 0.2 of 9 (the 0.0 of vehicle 2 is not rated).

    At the last moment: attackers 0.1 and 0.3, honest 0.2 of three.
    """
    value, last, _ = security.confusion(town, 0.35).to_dict("records")
    assert [value[k] for k in ("tp", "fp", "fn", "tn")] == [3, 1, 2, 8]
    assert (value["precision"], value["recall"], value["fpr"], value["f1"]) == (3 / 4, 3 / 5, 1 / 9, 6 / 9)
    assert value["mcc"] == pytest.approx((3 * 8 - 1 * 2) / np.sqrt(4 * 5 * 9 * 10))
    assert value["informedness"] == pytest.approx(3 / 5 - 1 / 9)
    assert [last[k] for k in ("tp", "fp", "fn", "tn")] == [2, 1, 0, 2]
    assert np.isnan(security.rates(0, 0, 0, 5)["recall"])


def test_false_exclusions_precision_and_error_by_hand(town):
    # vehicle 0 falls to 0.2 once; three honest vehicles are watched from step 3 to 7: 12 s
    assert security.false_exclusions(town, 0.35).value == pytest.approx(3600 / 12)
    # from below: 0.1 a, 0.2 h, 0.3 a a, 0.4 h h, 0.5 a, 0.6 h h, 0.7 a, 0.8 h, 0.9 h
    assert security.average_precision(town) == pytest.approx(0.2 + 0.4 * 3 / 4 + 0.2 * 4 / 7 + 0.2 * 5 / 10)
    error = security.trust_error(town).set_index("role").error
    assert error["malicious"] == pytest.approx(1.9 / 5) and error["honest"] == pytest.approx(1 - 3.9 / 7)


def test_messages_by_hand(tiny):
    """Attacker 1 from step 2; below 0.25 from step 5 on. A message is a lie if any detection in it is.

    Watched messages with a lie: steps 2, 4, 6 of vehicle 1 (6 after it is excluded); without: 3 and 7 of vehicle 1 (7
    excluded) and 2 and 6 of vehicle 0, which is excluded from step 5 on too. Step 1 is before any attack. In step 8 it
    sends nothing of what it has. The lie of step 2 is that it withholds something.
    """
    lists = [
        (1, 1, [1]),
        (2, 1, [0, 1]),
        (3, 1, [0]),
        (4, 1, [1]),
        (6, 1, [1, 1]),
        (7, 1, [0]),
        (2, 0, [0]),
        (6, 0, [0]),
    ]
    rows = [
        {"step": step, "observer": vehicle, "detection_index": k, "lied": bool(lied), "transmitted": k == 0}
        for step, vehicle, all_of in lists
        for k, lied in enumerate(all_of)
    ]
    rows += [{"step": 8, "observer": 1, "detection_index": k, "lied": True, "transmitted": False} for k in range(3)]
    table = {2: [0.9, 0.9], 5: [0.2, 0.1]}
    run = tiny(20, vehicles=attacking(["honest", "malicious"], {1: 2}), trust=values(table), detections=rows)
    row = security.confusion(run, 0.25).set_index("unit").loc["message"]
    assert [row[k] for k in ("tp", "fp", "fn", "tn")] == [1, 2, 2, 2]
    assert (row.precision, row.recall, row.fpr) == (1 / 3, 1 / 3, 2 / 4)


def test_exclusion_by_hand(tiny):
    """Attacker 1 from step 3, its second pseudonym refused from 9 on: 6 s. Attacker 2 from 5, never: to its end, 19.

    Honest 0 is revoked at 4, a second after the first attack; without revocation there is nothing to say.
    """
    names = [
        {"pseudonym": p, "vehicle": v, "from_step": a, "to_step": b, "refused_step": r}
        for p, v, a, b, r in ((0, 0, 0, 99, 4), (1, 1, 0, 6, None), (3, 1, 7, 99, 9), (2, 2, 0, 99, None))
    ]
    vehicles = attacking(["honest", "malicious", "malicious"], {1: 3, 2: 5})
    given = {"vehicles": vehicles, "pseudonyms": names}
    run = tiny(20, config={"pseudonyms": {"revocation": "list"}}, **given)
    delay = security.exclusion_delay(run).set_index("vehicle")
    assert delay.delay_s.to_dict() == {0: 1, 1: 6, 2: 14} and delay.found.tolist() == [True, True, False]
    found = misbehaviour.summary_of(security.exclusion_delay(run)).set_index("role")
    assert found.share.to_dict() == {"honest": 1, "malicious": 0.5} and found.median_s["malicious"] == 6
    with pytest.raises(ValueError, match="revokes no pseudonyms"):
        security.exclusion_delay(open_run_without(run))

"""Trust models as slow literal transcriptions of their equations: one holder, plain Python, no shared code.

Each takes the evaluations by step, rows (evaluator, subject, detection_index, e, phi), and gives trust by subject at
step `now`. Steps are `dt` seconds long; eta is -1.
"""

import math
from collections import defaultdict

SPELLED = {
    "decay_per_s": "decay", "correlation": "k", "evidence": "evidence_of", "consensus_margin": "margin",
    "restart_p": "a", "ban_strikes": "strikes_to_ban", "strike_window_s": "window_s", "claim_weight": "claim",
    "n_vehicles": "n", "least_agreement": "epsilon", "missed_p": "missed", "prior_benign": "prior",
    "prior_honest": "prior", "present_per_s": "present",
}  # fmt: skip
"""Parameters that have other names in the transcriptions, as in the papers."""


def spelled(own):
    """Parameters of a model as its transcription takes them."""
    return {SPELLED.get(name, name): value for name, value in own.items()}


def evidence(rows):
    """(evaluator, subject, index, pos, neg) of the evaluations that count: by others, for or against."""
    return [
        (v, i, k, phi * max(e, 0.0), phi * max(-e, 0.0))
        for v, i, k, e, phi in rows if v != i and round(phi * abs(e) * 2**32) > 0
    ]  # fmt: skip


def by_message(rows):
    """pos and neg by (evaluator, subject)."""
    sums = defaultdict(lambda: [0.0, 0.0])
    for v, i, _, pos, neg in evidence(rows):
        sums[v, i][0] += pos
        sums[v, i][1] += neg
    return sums


def known(steps):
    return {i for rows in steps.values() for _, i, *_ in evidence(rows)}


def beta(steps, now, dt, decay=0.98):
    r, s = defaultdict(float), defaultdict(float)
    for step, rows in steps.items():
        for _, i, _, pos, neg in evidence(rows):
            r[i] += decay ** ((now - step) * dt) * pos
            s[i] += decay ** ((now - step) * dt) * neg
    return {i: (r[i] + 1) / (r[i] + s[i] + 2) for i in known(steps)}


def beta_by_kind(steps, now, dt, decay=0.98, evidence_of=("detections",)):
    kinds = ("detections", "missing", "speed")
    sums = defaultdict(lambda: [0.0, 0.0])
    for step, rows in steps.items():
        for _, i, k, pos, neg in evidence(rows):
            kind = kinds[k % 3] if len(evidence_of) > 1 else "detections"
            sums[i, kind][0] += decay ** ((now - step) * dt) * pos
            sums[i, kind][1] += decay ** ((now - step) * dt) * neg
    return {
        i: min((sums[i, kind][0] + 1) / (sum(sums[i, kind]) + 2) for kind in evidence_of) for i in known(steps)
    }  # fmt: skip


def beta_correlated(steps, now, dt, decay=0.98, k=0.05):
    r, s = defaultdict(float), defaultdict(float)
    for step, rows in steps.items():
        for v, i, _, pos, neg in evidence(rows):
            r[v, i] += decay ** ((now - step) * dt) * pos
            s[v, i] += decay ** ((now - step) * dt) * neg
    trust = {}
    for i in known(steps):
        good = bad = 0.0
        for v in {v for v, subject in r if subject == i}:
            m = r[v, i] + s[v, i]
            share = 1.0 if m <= 1 else 1 / (1 + (m - 1) * k)
            good, bad = good + share * r[v, i], bad + share * s[v, i]
        trust[i] = (good + 1) / (good + bad + 2)
    return trust


def beta_discounted(steps, now, dt, decay=0.98):
    r, s, last = defaultdict(float), defaultdict(float), None
    for step in [*sorted(steps), now]:
        if last is not None:
            for i in r:
                r[i] *= decay ** ((step - last) * dt)
                s[i] *= decay ** ((step - last) * dt)
        if step in steps and step != last:
            before = {i: (r[i] + 1) / (r[i] + s[i] + 2) for i in r}
            for v, i, _, pos, neg in evidence(steps[step]):
                r[i] += before.get(v, 0.5) * pos
                s[i] += before.get(v, 0.5) * neg
        last = step
    return {i: (r[i] + 1) / (r[i] + s[i] + 2) for i in known(steps)}


def fuse(x, y):
    """Cumulative fusion of two opinions."""
    k = x[2] + y[2] - x[2] * y[2]
    return (x[0] * y[2] + y[0] * x[2]) / k, (x[1] * y[2] + y[1] * x[2]) / k, x[2] * y[2] / k


def aged(x, share):
    """An opinion of which a share of the evidence is left."""
    odds = x[0] / x[2] * share, x[1] / x[2] * share
    u = 1 / (1 + sum(odds))
    return odds[0] * u, odds[1] * u, u


def subjective_logic(steps, now, dt, decay=0.98, discounting="probability"):
    opinion, last = defaultdict(lambda: (0.0, 0.0, 1.0)), None
    for step in [*sorted(steps), now]:
        if last is not None:
            for i in opinion:
                opinion[i] = aged(opinion[i], decay ** ((step - last) * dt))
        if step in steps and step != last:
            before = dict(opinion)
            for v, i, _, pos, neg in evidence(steps[step]):
                weight = pos + neg
                gain = 1 - 1.3**-weight
                b, d = pos / weight * gain, neg / weight * gain
                source = before.get(v, (0.0, 0.0, 1.0))
                if discounting == "probability":
                    p = source[0] + source[2] / 2
                    one = p * b, p * d, 1 - p * (b + d)
                elif discounting == "opposite":
                    one = (
                        source[0] * b + source[1] * d, source[0] * d + source[1] * b,
                        source[2] + (source[0] + source[1]) * (1 - gain),
                    )  # fmt: skip
                else:
                    one = b, d, 1 - b - d
                opinion[i] = fuse(opinion[i], one)
        last = step
    return {i: opinion[i][0] + opinion[i][2] / 2 for i in known(steps)}


def mate(steps, now, dt):
    vehicle, last = defaultdict(lambda: [0.5, 0.5]), None
    for step in [*sorted(steps), now]:
        if last is not None:
            share = 0.9 ** ((step - last) * dt)
            for ab in vehicle.values():
                ab[:] = [0.5 + (x - 0.5) * share for x in ab]
        if step in steps and step != last:
            before = {i: ab[0] / sum(ab) for i, ab in vehicle.items()}
            objects = defaultdict(list)
            for v, i, k, pos, _ in evidence(steps[step]):
                objects[i, k].append((v, 1.0 if pos else 0.0))
            measured = []
            for (i, _), sources in objects.items():
                a = b = 0.5
                for source, v in [(i, 1.0), *sources]:
                    a += 0.5 * before.get(source, 0.5) * v
                    b += 0.5 * before.get(source, 0.5) * (1 - v)
                mean, std = a / (a + b), math.sqrt(a * b / ((a + b) ** 2 * (a + b + 1)))
                c = min(max(1 - 2 * std, 1e-4), 0.9999)
                measured += [(source, mean if v else 1 - mean, c) for source, v in [(i, 1.0), *sources]]
            for source, v, c in measured:
                n = 4 if v < 0.4 else 1
                vehicle[source][0] += n / (n + 1) * c * v
                vehicle[source][1] += n * n / (n + 1) * c * (1 - v)
        last = step
    return {i: vehicle[i][0] / sum(vehicle[i]) for i in known(steps)}


def minhas(steps, now, dt, gain=0.1, loss=-0.3, forgetting=0.98, margin=0.3):
    trust, when = defaultdict(float), {}
    for step in sorted(steps):
        before, votes = dict(trust), defaultdict(lambda: [0.0, 0.0])
        for (v, i), (pos, neg) in by_message(steps[step]).items():
            if pos != neg:
                votes[i][int(neg > pos)] += (1 + before.get(v, 0.0)) / 2
        for i, (good, bad) in votes.items():
            if good + bad == 0 or max(good, bad) < (1 - margin) * (good + bad):
                continue
            x, t = (gain if good > bad else loss), (step - when.get(i, step)) * dt
            value = forgetting**t * (1 - x) * trust[i] + x if trust[i] >= 0 else forgetting**-t * (1 + x) * trust[i] + x
            trust[i], when[i] = min(max(value, -1.0), 1.0), step
    return {i: (1 + trust[i]) / 2 for i in known(steps)}


def announcement(steps, now, dt, validity_s=600.0):
    ratings = defaultdict(lambda: defaultdict(list))
    for step, rows in steps.items():
        for (v, i), (pos, neg) in by_message(rows).items():
            if pos + neg:
                ratings[i][v].append((step, pos / (pos + neg)))
    out = {}
    for i in known(steps):
        means = []
        for one in ratings[i].values():
            weight = [max(1 - (now - step) * dt / validity_s, 0) for step, _ in one]
            if sum(weight):
                means.append(sum(w * x for w, (_, x) in zip(weight, one, strict=True)) / sum(weight))
        newest = max((step for one in ratings[i].values() for step, _ in one), default=-math.inf)
        out[i] = sum(means) / len(means) * max(1 - (now - newest) * dt / validity_s, 0) if means else 0.0
    return out


def power_iteration(local, p, a, tolerance=1e-6):
    """t <- (1 - a) C' t + a p, C from the matrix of local trust, as nested lists."""
    n = len(p)
    c = []
    for row in local:
        positive = [max(x, 0.0) for x in row]
        c.append([x / sum(positive) for x in positive] if sum(positive) else list(p))
    t = list(p)
    while True:
        new = [(1 - a) * sum(c[i][j] * t[i] for i in range(n)) + a * p[j] for j in range(n)]
        if sum(abs(x - y) for x, y in zip(new, t, strict=True)) < tolerance:
            return t
        t = new


def eigentrust(steps, now, dt, a=0.5):
    nodes = sorted({x for rows in steps.values() for v, i, *_ in evidence(rows) for x in (v, i)})
    at = {v: row for row, v in enumerate(nodes)}
    local = [[0.0] * len(nodes) for _ in nodes]
    for rows in steps.values():
        for v, i, _, pos, neg in evidence(rows):
            local[at[v]][at[i]] += pos - neg
    n = len(nodes)
    t = power_iteration(local, [1 / n] * n, a) if n else []
    return {i: n * t[at[i]] / (1 + n * t[at[i]]) for i in known(steps)}


def report_count(steps, now, dt):
    n = defaultdict(int)
    for rows in steps.values():
        for (_, i), (pos, neg) in by_message(rows).items():
            n[i] += neg > pos
    return {i: 5 / (5 + n[i]) for i in known(steps)}


def majority_ban(steps, now, dt, strikes_to_ban=20, window_s=20.0, decay=0.98):
    banned, strikes = set(), defaultdict(list)
    for step in sorted(steps):
        objects = defaultdict(list)
        for v, i, k, pos, neg in evidence(steps[step]):
            if (pos or neg) and v not in banned:
                objects[i, k].append((v, pos > 0))
        for (i, _), votes in objects.items():
            if all(agrees for _, agrees in votes):
                continue
            votes = votes if i in banned else [(i, True), *votes]
            n = sum(agrees for _, agrees in votes)
            for v, agrees in [*votes, *([(i, True)] if i in banned else [])]:
                if n != len(votes) - n and agrees != (n > len(votes) - n):
                    strikes[v].append(step)
        for v, when in strikes.items():
            if sum((step - g) * dt < window_s for g in when) >= strikes_to_ban:
                banned.add(v)
    return {i: 0.0 if i in banned else x for i, x in beta(steps, now, dt, decay).items()}

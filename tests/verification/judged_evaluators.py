"""The trust models that judge evaluators, as slow literal transcriptions: see `tests.verification.trust_models`.

`own` is the evaluator whose evaluations are the holder's own. `sent` gives, by step, the detections that each vehicle
transmitted.
"""

import math
from collections import defaultdict
from statistics import median

from tests.verification.trust_models import by_message, evidence, known


def rounded(x):
    """To multiples of 2^-32, as the models round what they add."""
    return round(x * 2**32) / 2**32


def by_detection(rows):
    """(evaluator, pos, neg) by (sender, index)."""
    found = defaultdict(list)
    for v, i, k, pos, neg in evidence(rows):
        found[i, k].append((v, rounded(pos), rounded(neg)))
    return found


def decayed_to(now, last, dt, decay, *tables):
    for table in tables:
        for counts in table.values():
            counts[:] = [x * decay ** ((now - last) * dt) for x in counts]


def evaluator_trust(steps, now, dt, decay=0.98, claim=0.5, own=None, own_weight=20.0):
    said, judged, last = defaultdict(lambda: [0.0, 0.0]), defaultdict(lambda: [0.0, 0.0]), None
    for step in [*sorted(steps), now]:
        if last is not None:
            decayed_to(step, last, dt, decay, said, judged)
        if step in steps and step != last:
            before = {v: (a + 1) / (a + d + 2) for v, (a, d) in judged.items()}
            vote = {v: own_weight if v == own else before.get(v, 0.5) for rows in steps.values() for v, *_ in rows}
            for (i, _), answers in by_detection(steps[step]).items():
                for v, pos, neg in answers:
                    others = rounded(claim * before.get(i, 0.5))
                    others += sum(rounded(vote[w] * (p - n)) for w, p, n in answers if w != v)
                    if others:
                        judged[v][int((others > 0) != (pos > neg))] += pos + neg
                    said[i][0] += vote[v] * pos
                    said[i][1] += vote[v] * neg
        last = step
    out = {}
    for i in known(steps):
        (r, s), (a, d) = said[i], judged[i]
        out[i] = (r + 1) / (r + s + 2) * (a + 1) / (a + d + 1)
    return out


def self_first(steps, now, dt, own=None, **settings):
    return evaluator_trust(steps, now, dt, own=own, **settings)


def miso_v(steps, now, dt, decay=0.98, n_sources=2):
    sender, evaluator, last = defaultdict(lambda: [0.0, 0.0]), defaultdict(lambda: [0.0, 0.0]), None
    for step in [*sorted(steps), now]:
        if last is not None:
            decayed_to(step, last, dt, decay, sender, evaluator)
        if step in steps and step != last:
            for (i, _), answers in by_detection(steps[step]).items():
                yes = [i] + [v for v, pos, neg in answers if pos > neg]
                no = [v for v, pos, neg in answers if neg > pos]
                if len(yes) == len(no) or max(len(yes), len(no)) < n_sources:
                    continue
                right, wrong = (yes, no) if len(yes) > len(no) else (no, yes)
                sender[i][int(right is no)] += 1
                for v in right:
                    evaluator[v][0] += v != i
                for v in wrong:
                    evaluator[v][1] += v != i
        last = step
    out = {}
    for i in known(steps):
        (g, b), (good, bad) = sender[i], evaluator[i]
        out[i] = (g + 1) / (g + b + 2) * (good + 1) / (good + bad + 1)
    return out


def median_groups(steps, now, dt, prior=0.5):
    r, s = defaultdict(float), defaultdict(float)
    for step, rows in steps.items():
        for edge, (pos, neg) in by_message(rows).items():
            r[edge] += 0.98 ** ((now - step) * dt) * pos
            s[edge] += 0.98 ** ((now - step) * dt) * neg
    share = {edge: r[edge] / (r[edge] + s[edge]) for edge in r if r[edge] + s[edge] > 0}
    nodes = {x for edge in share for x in edge}
    sender = {i: median([prior] + [x for (_, j), x in share.items() if j == i]) for i in nodes}
    off = {v: median([0.0] + [abs(x - sender[i]) for (w, i), x in share.items() if w == v]) for v in nodes}
    return {i: sender[i] * (1 - off[i]) for i in known(steps)}


def sigmoid(x):
    return 1 / (1 + math.exp(-x)) if x > 0 else math.exp(x) / (1 + math.exp(x))


def expectation_maximisation(detections, before, a, n_iterations):
    """Counts by vehicle: confirms and denies true ones, denies and confirms false ones; sends true and false ones."""
    counts = defaultdict(lambda: [0.0] * 6)
    for _ in range(n_iterations):

        def share(v, first, counts=counts):
            yes = before[v][first] + counts[v][first] + a
            return yes / (yes + before[v][first + 1] + counts[v][first + 1] + 1)

        new = defaultdict(lambda: [0.0] * 6)
        for i, answers in detections:
            logit = math.log(share(i, 4) / (1 - share(i, 4)))
            for v, pos, neg in answers:
                alpha, beta = share(v, 0), share(v, 2)
                logit += pos * math.log(alpha / (1 - beta)) + neg * math.log((1 - alpha) / beta)
            q = sigmoid(logit)
            new[i][4] += q
            new[i][5] += 1 - q
            for v, pos, neg in answers:
                for column, x in enumerate((q * pos, q * neg, (1 - q) * neg, (1 - q) * pos)):
                    new[v][column] += x
        counts = new
    return counts


def trust_of_counts(steps, counts, a):
    out = {}
    for i in known(steps):
        alpha, beta, pi = ((counts[i][k] + a) / (counts[i][k] + counts[i][k + 1] + a + 1) for k in (0, 2, 4))
        out[i] = pi * max(0.0, alpha + beta - 1)
    return out


def dawid_skene(steps, now, dt, a=4.0, n_iterations=8, window_s=20.0):
    nothing = defaultdict(lambda: [0.0] * 6)
    detections = [
        (i, answers)
        for step, rows in steps.items() if (now - step) * dt < window_s
        for (i, _), answers in by_detection(rows).items()
    ]  # fmt: skip
    return trust_of_counts(steps, expectation_maximisation(detections, nothing, a, n_iterations), a)


def dawid_skene_online(steps, now, dt, a=4.0, n_iterations=8, decay=0.95):
    total, last = defaultdict(lambda: [0.0] * 6), None
    for step in [*sorted(steps), now]:
        if last is not None:
            decayed_to(step, last, dt, decay, total)
        if step in steps and step != last:
            detections = [(i, answers) for (i, _), answers in by_detection(steps[step]).items()]
            for v, counts in expectation_maximisation(detections, total, a, n_iterations).items():
                total[v] = [x + y for x, y in zip(total[v], counts, strict=True)]
        last = step
    return trust_of_counts(steps, total, a)


def log_beta(a, b):
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def log_ratio(pos, neg, a, b):
    value = log_beta(a + pos, b + neg) - log_beta(a, b) - log_beta(1 + pos, 1 + neg)
    return min(max(value, -20.0), 20.0)


def belief_graph(steps, now, dt, sent, prior=0.8, coupling=1.0, n_sweeps=12, decay=0.95):
    edge, form = defaultdict(lambda: [0.0] * 4), defaultdict(lambda: [0.0] * 6)
    for step, rows in steps.items():
        left, certain, detects = decay ** ((now - step) * dt), defaultdict(int), set()
        for v, i, k, pos, neg in evidence(rows):
            pos, neg = rounded(pos), rounded(neg)
            edge[v, i][0 if k else 2] += left * pos
            edge[v, i][1 if k else 3] += left * neg
            certain[v, i] += pos == 1
            if 0 < pos < 1:
                detects.add(v)
            form[v][5 - (pos + neg > 0.5)] += left
        for (v, _), n in certain.items():
            form[v][3 if n > 1 else 2] += left
        for v in detects:
            form[v][1 if sent[step][v] <= 1 else 0] += left
    nodes = sorted({x for pair in edge for x in pair})
    alone = {}
    for v in nodes:
        alone[v, "sends"] = alone[v, "evaluates"] = math.log(prior / (1 - prior))
        f = form[v]
        alone[v, "evaluates"] += min(log_ratio(f[0], f[1], 20.0, 0.2), 0) + min(log_ratio(f[2], f[3], 20.0, 0.2), 0)
        k, n = f[4], f[4] + f[5]
        chance = log_beta(8 + k, 3.5 + n - k) - log_beta(8, 3.5) + n * math.log(2)
        alone[v, "evaluates"] += min(max(chance, -20.0), 0.0)
    factors = [((v, "evaluates"), (v, "sends"), coupling) for v in nodes]
    for (v, i), sums in edge.items():
        r, s, of_self, against = sums
        factors.append(
            ((v, "evaluates"), (i, "sends"), log_ratio(r, s, 7.0, 2.0) + log_ratio(of_self, against, 2.0, 0.8))
        )
    message = {(f, end): 0.0 for f in range(len(factors)) for end in (0, 1)}

    def belief(node):
        return alone[node] + sum(message[f, e] for f, ends in enumerate(factors) for e in (0, 1) if ends[e] == node)

    for _ in range(n_sweeps):
        at = {node: belief(node) for node in alone}
        new = {}
        for f, (*ends, ratio) in enumerate(factors):
            for e in (0, 1):
                p = sigmoid(at[ends[1 - e]] - message[f, 1 - e])
                q = sigmoid(message[f, 1 - e] - at[ends[1 - e]])
                new[f, e] = (message[f, e] + math.log(q + p * math.exp(ratio))) / 2
        message = new
    honest = {node: sigmoid(belief(node)) for node in alone}
    out = {}
    for i in known(steps):
        pos, neg = 20.0, 6.0
        for (v, j), (r, s, of_self, against) in edge.items():
            if j == i:
                pos += honest[v, "evaluates"] * (r + of_self)
                neg += honest[v, "evaluates"] * (s + against)
        out[i] = honest[i, "evaluates"] * honest[i, "sends"] * pos / (pos + neg)
    return out

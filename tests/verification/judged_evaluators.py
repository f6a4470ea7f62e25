"""The trust models that judge evaluators, as slow literal transcriptions: see `tests.verification.trust_models`.

`own` is the evaluator whose evaluations are the holder's own. `sent` gives, by step, the detections that each vehicle
transmitted. A message is known as long as it is younger than `grace`.
"""

import math
from collections import defaultdict
from statistics import median

import numpy as np
from scipy import stats

from cosim.base.rng import draws
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


def agreement(rows, reliable):
    """By vehicle: confirmed and denied of its detections, shared and contradicted of its evaluations."""
    said = defaultdict(lambda: [0.0] * 4)
    for (i, _), answers in by_detection(rows).items():
        for v, pos, neg in answers:
            said[i][0] += rounded(reliable(v) * pos)
            said[i][1] += rounded(reliable(v) * neg)
            votes = [rounded(reliable(w) * (p - n)) for w, p, n in answers if w != v]
            others = rounded(reliable(i)) + sum(votes)
            said[v][2] += pos if others > 0 else 0.0
            said[v][3] += neg if others > 0 else pos if others < 0 else 0.0
    return said


def prbi(steps, now, dt, n=5, epsilon=0.5, prior=0.8, memory=0.5, missed=0.3, decay=0.98):
    verifications, posterior = [], {}  # (step, members, failed); last P by vehicle

    def number(at, failed, counts):
        weights = [decay ** ((at - s) * dt) for s, group, fails in verifications if fails == failed and counts(group)]
        return sum(weights)

    def benign(j, at):
        passed = number(at, False, lambda group: j in group)
        failed = number(at, True, lambda group: j in group)
        share = (passed + 2 * prior) / (passed + failed + 2)
        return memory * posterior.get(j, prior) + (1 - memory) * share

    vehicles = {j for rows in steps.values() for v, i, *_ in rows for j in (v, i)}
    for step in sorted(steps):
        before = {j: round(benign(j, step), 6) for j in vehicles}
        reliable = {j: x if x >= 0.5 else 0.0 for j, x in before.items()}
        said = agreement(steps[step], reliable.get)
        draw = {}
        for j, columns in said.items():
            lot = tuple(np.array([x * 2**32], np.uint64) for x in columns)
            draw[j] = draws(0, round(step * dt * 1000), lot)[0, 0]
        speak = sorted(j for j in said if sum(said[j]) > 0)
        speak.sort(key=draw.get)
        passed, failed = number(step, False, bool), number(step, True, bool)
        m = math.floor(math.log2((passed + failed + 1) / (passed + 1)) + 1e-9)
        found = []
        for first in range(0, len(speak), n):
            table = sorted(speak[first : first + n], key=before.get)
            n_suspects = min(max(m, 1), max(len(table) - 1, 1))
            for group in (table[:n_suspects], table[n_suspects:]):
                good = sum(said[j][0] + said[j][2] for j in group)
                bad = sum(said[j][1] + said[j][3] for j in group)
                if group:
                    found.append((step, group, good < epsilon * (good + bad)))
        for _, group, fails in found:
            for j in group:
                p = number(step, False, lambda group, j=j: j not in group)
                f = number(step, True, lambda group, j=j: j not in group)
                anomaly = (f + 1) / (p + f + 2)
                a, b = (anomaly, 1.0) if fails else (1 - anomaly, missed)
                a, b = a * before[j], b * (1 - before[j])
                posterior[j] = a / (a + b)
        verifications += found
    return {i: benign(i, now) for i in known(steps)}


def false_discovery(steps, now, dt, level=0.05, present=0.9, decay=0.98, k=0.05):
    here, ever = (defaultdict(lambda: np.zeros(4)) for _ in range(2))
    for step, rows in steps.items():
        age_s = (now - step) * dt
        for j, said in agreement(rows, lambda j: 1.0).items():
            here[j] += np.array(said) * present**age_s
            ever[j] += np.array(said) * decay**age_s
    p, tested = {}, [j for j in here if here[j].sum() >= 0.01]
    for j in tested:
        values = []
        for role in (slice(0, 2), slice(2, 4)):
            yes, no = sum(ever[i][role] for i in tested)
            rate = (no + 1) / (yes + no + 2)
            past_yes, past_no = ever[j][role] - here[j][role]
            own = (past_no + 5 * rate) / (past_yes + past_no + 5)
            c, d = here[j][role]
            worth = 1 / (1 + k * max(c + d - 1, 0))
            for r in (rate, own):
                values.append(stats.beta.cdf(r, d * worth, c * worth + 1) if d else 1.0)
        p[j] = stats.combine_pvalues(values, "fisher").pvalue
    t = level / max(len(p), 1)
    for j, x in enumerate(sorted(p.values()), 1):
        if x <= j * level / len(p):
            t = j * level / len(p)
    trust = {}
    for i, x in p.items():
        trust[i] = x / t / 2 if x <= t else 1 - (1 - x) / (1 - t) / 2
    return {i: trust.get(i, 1.0) for i in known(steps)}


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


def dirichlet(counts, shape):
    value = math.lgamma(sum(shape)) - math.lgamma(sum(shape) + sum(counts))
    return value + sum(math.lgamma(a + n) - math.lgamma(a) for n, a in zip(counts, shape, strict=True))


def add_exp(x, y):
    return max(x, y) + math.log1p(math.exp(-abs(x - y)))


SHAPES = {
    "detections": ((21.0, 5.0, 1.7, 1.7), (2.0, 0.7, 1.1, 0.8), (0.6, 1.1, 0.5, 0.5)),
    "missing": ((30.0, 6.0), (0.3, 1.0), (0.3, 0.8)),
    "speed": ((20.0, 1.0), (2.0, 3.0), (1.3, 2.8)),
}


def newest_message(sent, v, step, dt, grace):
    """Number of detections in the newest message of v."""
    for earlier in range(step, -1, -1):
        if (step - earlier) * dt >= grace:
            return 0
        if sent[earlier].get(v):
            return sent[earlier][v]
    return 0


def edges_and_forms(steps, now, dt, sent, n_kinds, decay, grace):
    """By (v, i): outcomes of each kind, and further detections not certain and certain. By v: counts of form."""
    edge, form = {}, defaultdict(lambda: [0.0] * 5)
    for step, rows in steps.items():
        left, said = decay ** ((now - step) * dt), defaultdict(list)
        made, certain, detects = defaultdict(int), defaultdict(int), set()
        for v, i, k, pos, neg in evidence(rows):
            said[i, k].append((v, rounded(pos), rounded(neg)))
        for (i, k), answers in said.items():
            kind = k % n_kinds
            for v, pos, neg in answers:
                nothing = {name: [0.0] * len(x[0]) for name, x in SHAPES.items()} | {"certain": [0.0] * 2}
                of = edge.setdefault((v, i), nothing)
                made[v, i] += kind == 0
                if kind == 0:
                    others = [(p, n) for w, p, n in answers if w != v]
                    denied = 1 if any(p > 0 for p, _ in others) else 2 if any(n > 0 for _, n in others) else 3
                    of["detections"][0] += left * pos
                    of["detections"][denied] += left * neg
                    certain[v, i] += pos == 1
                    form[v][2 if pos + neg > 0.5 else 3] += left
                    if 0 < pos < 1:
                        detects.add(v)
                else:
                    if kind == 1 or k == 2:
                        of[("missing", "speed")[kind - 1]][0] += left * pos
                        of[("missing", "speed")[kind - 1]][1] += left * neg
                    if pos + neg >= 1 or (kind == 1 and pos > 0.34):
                        form[v][4] += left
        for v, i in made:
            further = max(certain[v, i] - 1, 0)
            edge[v, i]["certain"][0] += left * (max(made[v, i] - 1, 0) - further)
            edge[v, i]["certain"][1] += left * further
        for v in detects:
            n_listed = newest_message(sent, v, step, dt, grace)
            n_sent = n_listed if n_kinds == 1 else (n_listed - 16) // 2
            form[v][1 if n_sent <= 1 else 0] += left
    return edge, form


def bounded(x):
    return min(max(x, -20.0), 20.0)


def belief_graph(
    steps, now, dt, sent, grace, evidence_of=("detections",), prior=0.8, coupling=0.5, n_sweeps=12, decay=0.95
):
    edge, form = edges_and_forms(steps, now, dt, sent, 3 if len(evidence_of) > 1 else 1, decay, grace)
    nodes = sorted({x for pair in edge for x in pair})
    odds = {(v, role): math.log(prior / (1 - prior)) for v in nodes for role in ("evaluator", *evidence_of)}
    for v in nodes:
        f = form[v]
        odds[v, "evaluator"] += min(log_ratio(f[0], f[1], 20.0, 0.2), 0)
        drawn = log_beta(8 + f[2], 3.5 + f[3]) - log_beta(8, 3.5) + (f[2] + f[3]) * math.log(2)
        odds[v, "evaluator"] += min(max(drawn, -20.0), 0.0) - min(10 * f[4], 200)
    factors = [((v, "evaluator"), (v, kind), coupling, 0.0) for v in nodes for kind in evidence_of]
    for (v, i), of in edge.items():
        honest, liar = dirichlet(of["certain"], (60.0, 1.5)), dirichlet(of["certain"], (0.5, 0.1))
        certain = min(max(honest - add_exp(honest, liar) + math.log(2), -20.0), 0.0)
        for kind in evidence_of:
            both, sender, evaluator = (dirichlet([0.5 * x for x in of[kind]], shape) for shape in SHAPES[kind])
            lies = add_exp(math.log(0.8) + both, math.log(0.2) + evaluator)
            more = certain if kind == "detections" else 0.0
            factors.append(((v, "evaluator"), (i, kind), bounded(both - lies) + more, bounded(sender - lies) + more))
    message = {(f, end): 0.0 for f in range(len(factors)) for end in (0, 1)}
    at = dict(odds)
    for _ in range(n_sweeps):
        for f, (v, i, both, first) in enumerate(factors):
            to_v, to_i = message[f, 0], message[f, 1]
            of_v, of_i = at[v] - to_v, at[i] - to_i
            message[f, 0] = (to_v + add_exp(first, of_i + both) - add_exp(0, of_i)) / 2
            message[f, 1] = (to_i + add_exp(0, of_v + both) - add_exp(0, of_v + first)) / 2
        at = dict(odds)
        for (f, end), x in message.items():
            at[factors[f][end]] += x
    out = {}
    for i in known(steps):
        total = {kind: [0.0] * len(SHAPES[kind][0]) for kind in evidence_of}
        for (v, j), of in edge.items():
            for kind in evidence_of if j == i else ():
                believed = sigmoid(at[v, "evaluator"])
                total[kind] = [x + believed * 0.5 * y for x, y in zip(total[kind], of[kind], strict=True)]
        confirmed, _, jointly, single = total["detections"]
        out[i] = sigmoid(at[i, "evaluator"]) * ((30 + confirmed) / (35 + confirmed + jointly + single)) ** 2
        for kind in evidence_of[1:]:
            gain = dirichlet(total[kind], SHAPES[kind][0]) - dirichlet(total[kind], SHAPES[kind][1])
            out[i] *= sigmoid(math.log(9) + min(gain, 1.0))
    return out

"""What a soak found: as data, as text, and as a verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import quantiles

from drivers.clock import NS_PER_S
from tests.soak.evidence import DEADLINE_S, Verdict
from tests.soak.faults import EVIDENCE, RECOVERIES
from tests.soak.losses import Account, Item
from tests.soak.memory import Growth


@dataclass(frozen=True)
class Report:
    """A soak.

    Attributes:
        minutes, rate, seed: how it was run.
        accounts: link -> what was lost.
        growth: of memory; None if the soak was too short for it.
        verdicts: fault -> how it was shown.
        inconsistencies: in the store.
        observations: as `consistency.untruths` counts them.
        examples: of observations that are not true.
        stop: exit status of the daemon, and how long it took to stop.
        answers_s: how long `status` took.
        done, refused: of the operator's commands.
        ended: why the soak could not be carried through; "" if it could.
    """

    minutes: float
    rate: float
    seed: int
    accounts: Mapping[str, Account]
    growth: Growth | None
    verdicts: Mapping[str, Verdict]
    inconsistencies: Sequence[str]
    observations: Counter[str]
    examples: Sequence[str]
    stop: tuple[int | None, float]
    answers_s: Sequence[float]
    done: Counter[str]
    refused: Counter[str]
    ended: str = ""

    def faults(self) -> list[str]:
        """Every bar that was missed, in words."""
        found = [self.ended] if self.ended else []
        for link, account in self.accounts.items():
            if account.untold:
                found.append(f"{link}: {len(account.untold)} lost without a gap: {_when(account.untold)}")
            if account.foreign:
                found.append(f"{link}: {len(account.foreign)} stored that were never sent: {_when(account.foreign)}")
            if account.backwards:
                found.append(f"{link}: {account.backwards} stamps run backwards")
            found += [f"{link}: {text}" for text in account.understated]
        found += self.growth.faults() if self.growth is not None else []
        for name, verdict in self.verdicts.items():
            if name not in RECOVERIES and verdict.late + verdict.never:
                worst = "" if verdict.worst_s is None else f", at worst after {verdict.worst_s:.1f} s"
                of = verdict.injected - verdict.masked
                found.append(f"{name}: of {of}, {verdict.never} never shown, {verdict.late} late{worst}")
        found += [f"{name}: never injected" for name in EVIDENCE if name not in self.verdicts]
        found += self.inconsistencies
        found += [f"{n} observations: {what}" for what, n in self.observations.items() if what != "observations"]
        status, seconds = self.stop
        if status != 0 or seconds > 30.0:
            found.append(f"the daemon took {seconds:.1f} s to stop, exit status {status}; allowed: 30 s and 0")
        return found

    def text(self) -> str:
        """For people."""
        lines = [f"soak: {self.minutes:g} min at {self.rate:g} times real time, seed {self.seed}", ""]
        lines.append(f"{'fault':30} {'injected':>8} {'masked':>7} {'worst s':>8} {'late':>5} {'never':>6}")
        for name, verdict in self.verdicts.items():
            worst = "-" if verdict.worst_s is None else f"{verdict.worst_s:.2f}"
            counts = f"{verdict.late:>5} {verdict.never:>6}" + ("  (no bar)" if name in RECOVERIES else "")
            lines.append(f"{name:30} {verdict.injected:>8} {verdict.masked:>7} {worst:>8} {counts}")
        lines += [
            "",
            f"bar: {DEADLINE_S:g} s on the rig's clock to the stamp, and real seconds until it can be read",
            "",
        ]
        for link, a in self.accounts.items():
            lines.append(
                f"{link}: sent {a.sent}, stored {a.stored}, lost {a.lost}, of these in gaps {a.told}; delay of stamps, "
                f"99th percentile: {a.delay_p99_s * 1e3:.0f} ms of the rig"
            )
        if self.growth is not None:
            g = self.growth
            lines.append(
                f"memory: {g.base_kib / 1024:.1f} MiB warm after {g.warm_s:.0f} s, at most {g.most_kib / 1024:.1f}, at "
                f"the end {g.end_kib / 1024:.1f} after {g.end_s:.0f} s, trend {100 * g.trend:+.1f} %; "
                f"descriptors {g.descriptors[0]} -> {g.descriptors[1]}, "
                f"threads {g.threads[0]} -> {g.threads[1]}"
            )
        else:
            lines.append("memory: not judged, the daemon did not live long enough after its warm-up")
        if len(self.answers_s) > 1:
            cuts = quantiles(self.answers_s, n=100)
            lines.append(
                f"status: {len(self.answers_s)} answers, median {cuts[49]:.2f} s, 99th percentile {cuts[98]:.2f} s"
            )
        lines.append("observations: " + ", ".join(f"{n} {what}" for what, n in self.observations.items()))
        lines.append(f"stop: exit status {self.stop[0]} after {self.stop[1]:.1f} s")
        lines.append("commands: " + ", ".join(f"{n} {what}" for what, n in sorted(self.done.items())))
        lines += [f"refused {n} times: {what}" for what, n in self.refused.most_common(12)]
        lines += ["", *self.examples] if self.examples else []
        faults = self.faults()
        lines += ["", *[f"MISSED  {fault}" for fault in faults]]
        lines.append("the soak is passed" if not faults else f"the soak is not passed: {len(faults)} bars missed")
        return "\n".join(lines)


def _when(items: Sequence[Item]) -> str:
    """A few instants, runs drawn together."""
    runs: list[list[int]] = []
    for item in items:
        if runs and item.at_ns - runs[-1][1] < NS_PER_S // 2:
            runs[-1][1] = item.at_ns
            runs[-1][2] += 1
        else:
            runs.append([item.at_ns, item.at_ns, 1])
    some = [f"{n} in {(b - a) / NS_PER_S:.2f} s from {a / NS_PER_S:.2f} s" for a, b, n in runs[:6]]
    return "; ".join(some) + (f"; and {len(runs) - 6} more" if len(runs) > 6 else "")

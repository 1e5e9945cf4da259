"""The contract of a rule of the audit (`mi_splat.audit.rules.Rule`)."""

from __future__ import annotations

import re
from typing import Any, get_args

import numpy as np

from attacks.testing.promises import Contract, cloud, expect
from mi_splat.audit.rules import RULES, Rule, Severity, Stored
from mi_splat.io.loaded import Loaded, arrays_of
from mi_splat.scene import GaussianScene


def check_rule(rule: Any, *, finds: GaussianScene | None = None) -> None:
    """Raise unless a rule of the audit keeps its contract.

    It looks at healthy splats of any degree and size, in which there is nothing to find, and at one of broken numbers.

    Args:
        rule: The rule.
        finds: A splat in which it has to find something.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"rule {getattr(rule, 'name', type(rule).__name__)}")
    with contract.promise("names"):
        expect(isinstance(rule, Rule), "a Rule", type(rule).__name__, "make one of mi_splat.audit.rules.Rule")
        good = re.fullmatch(r"[a-z][a-z0-9-]*", rule.name)
        expect(good, "a name of small letters, digits and dashes", rule.name, "choose another")
        taken = rule is not None and any(rule.name == own.name and rule is not own for own in RULES)
        expect(not taken, "a name that is free", rule.name, "choose another")
        expect(rule.severity in get_args(Severity), " or ".join(get_args(Severity)), rule.severity, "choose one")
        expect(rule.reason.endswith("."), "a sentence as reason", rule.reason, "say why it matters, and end it with .")
    contract.settle()
    for count, degree in ((60, 3), (60, 0), (1, 1)):
        with contract.promise("healthy splats"):
            finding = rule(_stored(cloud(count, degree)))
            got = "" if finding is None else f"a finding in {finding.count} of {count}"
            expect(finding is None, "nothing", got, "raise the threshold")
    with contract.promise("broken numbers"):
        broken = _stored(cloud(60, 1), broken=True)
        rule(broken)
    with contract.promise("determinism"):
        splat = _stored(cloud(60, 3) if finds is None else finds)
        kept = {name: value.copy() for name, value in splat.arrays.items()}
        same = np.array_equal(rule.find(splat, rule.threshold), rule.find(splat, rule.threshold))
        expect(same, "the same rows in a second look", "others", "draw nothing")
        stayed = all(np.array_equal(kept[name], value) for name, value in splat.arrays.items())
        expect(stayed, "arrays that stay as they are", "others", "work on copies")
    if finds is not None:
        with contract.promise("what it finds"):
            expect(rule(_stored(finds)) is not None, "a finding", "none", "lower the threshold")
    contract.settle()


def _stored(scene: GaussianScene, *, broken: bool = False) -> Stored:
    loaded = Loaded(arrays_of(scene), np.array([1, 2] if broken else [], np.int64), "")
    if broken:
        loaded.arrays["means"][1], loaded.arrays["scales"][2] = np.nan, -1.0
    return Stored.of(loaded)

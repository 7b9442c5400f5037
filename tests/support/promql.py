"""Dashboards and alert rules against what is really exported: selectors of PromQL expressions, and
the alerts' truth between two scrapes. Needs `promql-parser` and the extra `telemetry`."""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import promql_parser as pql
import yaml
from prometheus_client.parser import text_string_to_metric_families

from tests.support.paths import ROOT

type Labels = frozenset[tuple[str, str]]
type Vector = dict[Labels, float]
type Scrape = dict[str, Vector]
"""Samples by name of the series."""

TARGET_LABELS = frozenset({"instance", "job"})
"""Prometheus adds these to every sample that it scrapes."""
DASHBOARDS = ROOT / "configs" / "grafana"
RULES = ROOT / "configs" / "prometheus" / "rules.yml"


def scrape(text: str) -> Scrape:
    """Read a page of a Prometheus endpoint. A label without a value is no label."""
    found: Scrape = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = frozenset((key, value) for key, value in sample.labels.items() if value)
            found.setdefault(sample.name, {})[labels] = sample.value
    return found


def panels(name: str) -> dict[str, pql.Expr]:
    """Expressions of a dashboard, parsed, by their text."""
    shown = json.loads((DASHBOARDS / name).read_text())
    texts = [target["expr"] for panel in shown["panels"] for target in panel["targets"]]
    for variable in shown["templating"]["list"]:  # label_values(METRIC, LABEL)
        if isinstance(variable["query"], dict):
            metric, label = variable["query"]["query"][len("label_values(") : -1].split(", ")
            texts.append(f"count by ({label}) ({metric})")
    return {text: pql.parse(_without_variables(text)) for text in texts}


def named_without_series(name: str, pages: Sequence[Scrape]) -> list[str]:
    """Return the labels in a dashboard's legends that no sample of their curve has."""
    shown = json.loads((DASHBOARDS / name).read_text())
    missing = []
    for target in (target for panel in shown["panels"] for target in panel["targets"]):
        expression = pql.parse(_without_variables(target["expr"]))
        for label in re.findall(r"{{(\w+)}}", target["legendFormat"]):
            if label not in _labels(expression, pages):
                missing.append(f"{label} in the legend of {target['expr']}")
    return missing


def _labels(expression: pql.Expr, pages: Sequence[Scrape]) -> set[str]:
    """Return the labels that an expression may have: those it groups by, or its series'."""
    grouped = grouped_by(expression) - TARGET_LABELS
    found = (matched(one, page) for one in selectors(expression) for page in pages)
    return grouped or {label for vector in found for key in vector for label, _ in key}


def described(group: str) -> dict[str, set[str]]:
    """Return the labels in the texts of a group's alerts, by the alert's name."""
    groups = {one["name"]: one["rules"] for one in yaml.safe_load(RULES.read_text())["groups"]}
    return {
        rule["alert"]: set(re.findall(r"\$labels\.(\w+)", json.dumps(rule["annotations"])))
        for rule in groups[group]
    }


def alerts(group: str) -> dict[str, pql.Expr]:
    """Expressions of a group of alert rules, parsed, by the alert's name."""
    groups = {one["name"]: one["rules"] for one in yaml.safe_load(RULES.read_text())["groups"]}
    return {rule["alert"]: pql.parse(rule["expr"]) for rule in groups[group]}


def _without_variables(text: str) -> str:
    return text.replace("$__rate_interval", "1m").replace('=~"$gpu"', '=~".*"')


def selectors(expression: pql.Expr) -> list[pql.VectorSelector]:
    found: list[pql.VectorSelector] = []

    def see(node: pql.Expr) -> None:
        if isinstance(node, pql.VectorSelector):
            found.append(node)

    pql.walk(expression, see)
    return found


def grouped_by(expression: pql.Expr) -> set[str]:
    """Return the labels by which an expression groups or matches."""
    found: set[str] = set()

    def see(node: pql.Expr) -> None:
        modifier = getattr(node, "modifier", None)
        if isinstance(node, pql.BinaryExpr) and modifier is not None:
            modifier = modifier.matching
        if modifier is not None:
            found.update(modifier.labels)

    pql.walk(expression, see)
    return found


def matched(selector: pql.VectorSelector, seen: Scrape) -> Vector:
    """Return the samples that a selector selects."""
    assert selector.name is not None
    return {
        labels: value
        for labels, value in seen.get(selector.name, {}).items()
        if all(_matches(one, dict(labels)) for one in selector.matchers.matchers)
    }


def _matches(matcher: pql.Matcher, labels: Mapping[str, str]) -> bool:
    value = labels.get(matcher.name, "")
    same = (
        re.fullmatch(matcher.value, value) is not None
        if matcher.op in (pql.MatchOp.Re, pql.MatchOp.NotRe)
        else value == matcher.value
    )
    return same is (matcher.op in (pql.MatchOp.Equal, pql.MatchOp.Re))


def unknown(expression: pql.Expr, pages: Sequence[Scrape]) -> set[str]:
    """Return what an expression names and no page has: selectors, and labels of its grouping."""
    missing, labels = set(), set(TARGET_LABELS | {"le"})
    for selector in selectors(expression):
        found = [key for page in pages for key in matched(selector, page)]
        labels |= {label for key in found for label, _ in key}
        if not found:
            missing.add(str(selector))
    return missing | (grouped_by(expression) - labels)


# -- truth of an alert
def fires(expression: pql.Expr, before: Scrape, after: Scrape) -> bool:
    """Whether an alert is true at `after`, if `before` is what the range began with."""
    return bool(_value(expression, before, after))


_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    ">": lambda a, b: a > b,
    "==": lambda a, b: a == b,
}


def _value(node: Any, before: Scrape, after: Scrape) -> Any:
    """Evaluate the part of PromQL that the rules use; anything else is an error."""
    match node:
        case pql.NumberLiteral():
            return node.val
        case pql.VectorSelector():
            return matched(node, after)
        case pql.BinaryExpr():
            left, right = (_value(side, before, after) for side in (node.lhs, node.rhs))
            if (operator := str(node.op)) in _OPERATORS:
                holds = _OPERATORS[operator]
                return {key: value for key, value in left.items() if holds(value, right)}
            if operator == "or":
                return right | left
            assert operator == "unless", f"{operator} is not evaluated"
            assert node.modifier is not None
            assert node.modifier.matching is not None
            on = set(node.modifier.matching.labels)
            gone = {_only(on, key) for key in right}
            return {key: value for key, value in left.items() if _only(on, key) not in gone}
        case pql.Call():
            return _called(node, before, after)
    raise AssertionError(f"{node} is not evaluated")


def _called(call: pql.Call, before: Scrape, after: Scrape) -> Vector:
    (given,) = call.args
    match call.func.name:
        case "absent":
            return {} if matched(given, after) else {frozenset(): 1.0}
        case "count_over_time":
            return matched(given.vector_selector, before) | matched(given.vector_selector, after)
        case "increase":
            then, now = (matched(given.vector_selector, seen) for seen in (before, after))
            # a series that begins later does not increase by its first value
            return {key: now[key] - value for key, value in then.items() if key in now}
    raise AssertionError(f"{call.func.name} is not evaluated")


def _only(names: set[str], labels: Labels) -> Labels:
    return frozenset((key, value) for key, value in labels if key in names)


def metrics_of(seen: Scrape, prefix: str) -> Iterator[str]:
    """Yield the names of a scrape's metrics, without the suffixes of a histogram's series."""
    for name in seen:
        if name.startswith(prefix) and not name.endswith("_created"):
            yield re.sub(r"_(bucket|count|sum)$", "", name)

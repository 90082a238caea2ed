"""Objects show themselves in one line and in a table of HTML: short for any batch, whole, and without a failure."""

from html.parser import HTMLParser

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic import random_tally

from jaxgran.model.display import Row, html_of, text_of, value_text, with_error
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.sample import BLOCKS, Sample

GRAINS, REPLICAS = 64, 1000


def flow(replicas: int | None = None) -> ShearFlow:
    alpha = 0.5 if replicas is None else np.linspace(0.1, 0.9, replicas)
    return ShearFlow(GRAINS, alpha, 0.6, 1e-4)


def state(replicas: int | None = None) -> State:
    random, axes = np.random.default_rng(0), () if replicas is None else (replicas,)
    radii = random.uniform(0.4, 0.6, (*axes, GRAINS))
    positions, velocities = random.uniform(0, 9, (2, *axes, GRAINS, 2))
    return State(Grains(radii, 4 * radii**2), positions, velocities, np.full(axes, 9.0), np.full(axes, 0.25))


def sample(replicas: int | None = None, status: int = Status.ok) -> Sample:
    axes = () if replicas is None else (replicas,)
    tally = random_tally(np.random.default_rng(0), *axes, BLOCKS, status=status)
    return Sample(tally, np.full(axes, 81.0)[()], np.ones(axes)[()], GRAINS)


MADE = {"ShearFlow": flow, "State": state, "Sample": sample}


class Cells(HTMLParser):
    """The texts of the cells of a table; fails where an element is not closed by its own end."""

    def __init__(self, html: str):
        super().__init__()
        self.open: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs) -> None:
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("th", "td"):
            self.rows[-1].append("")

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if self.open[-1] in ("th", "td"):
            self.rows[-1][-1] += data


def cells(thing) -> dict[str, list[str]]:
    """The rows of the table of a thing, by their names."""
    return {name: rest for name, *rest in Cells(thing._repr_html_()).rows}


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("replicas", [None, REPLICAS])
def test_line_and_table_are_short_whole_and_of_the_same_rows(name: str, replicas: int | None) -> None:
    thing = jax.tree.map(jnp.asarray, MADE[name](replicas))
    line, rows = repr(thing), cells(thing)
    assert line.startswith(f"{name}(") and line.endswith(")")
    assert "\n" not in line and len(line) < 700
    assert len(thing._repr_html_()) < 6000
    shown = [part.split("=")[0].replace("_", " ") for part in line.removeprefix(f"{name}(").split(", ") if "=" in part]
    assert shown == list(rows)
    assert all(len(row) == 2 for row in rows.values())


def test_one_flow_is_shown_as_it_is_written() -> None:
    one = flow()
    assert eval(repr(one)) == one


def test_batch_is_shown_by_its_number_and_range() -> None:
    assert f"restitution=<{REPLICAS} values, 0.1 to 0.9>" in repr(flow(REPLICAS))
    assert cells(state(REPLICAS))["replicas"][0] == str(REPLICAS)


def test_state_tells_what_a_picture_of_it_would() -> None:
    one = state()
    rows = cells(one)
    temperature = np.sum(one.grains.masses[:, None] * one.velocities**2) / (2 * GRAINS)
    assert float(rows["granular temperature"][0]) == pytest.approx(temperature, rel=1e-5)
    area = np.pi * np.sum(one.grains.radii**2)
    assert float(rows["packing fraction"][0]) == pytest.approx(area / 81, rel=1e-5)
    assert rows["precision"][0] == "float64"


def test_sample_shows_its_averages_with_their_errors_and_its_status() -> None:
    one = sample(status=Status.deep_overlap)
    rows, errors = cells(one), one.errors()
    for name in ("force_ratio", "pressure", "granular_temperature"):
        expected = with_error(float(one.averages[name]), float(errors[name]))
        assert rows[name.replace("_", " ")][0] == expected
        assert f"{name}={expected}" in repr(one)
    assert rows["status"][0] == "deep_overlap"
    assert rows["pressure"][1] == "m/t²"


def test_statuses_of_a_batch_are_counted() -> None:
    batch = sample(5)
    batch.tally.status[3, 7] = Status.not_steady
    assert cells(batch)["status"][0] == "ok (4), not_steady (1)"


def test_what_values_hold_is_escaped() -> None:
    class Wicked:
        def __repr__(self) -> str:
            return "<script>alert('&')</script>\n" * 50

    rows = [Row("a<b", Wicked(), "<m>"), Row("text", "</td><td>")]
    html = html_of("T<", rows, "note & <i>")
    assert "<script" not in html and "<i>" not in html and "T&lt;" in html
    assert [row[0] for row in Cells(html).rows] == ["a<b", "text"]
    assert Cells(html).rows[1][1] == "</td><td>"
    assert "\n" not in text_of("T", rows) and len(text_of("T", rows)) < 300


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("leaf", [None, jax.ShapeDtypeStruct((3,), float)], ids=["None", "shape"])
def test_whatever_stands_in_the_place_of_a_number_is_shown(name: str, leaf) -> None:
    """JAX fills its trees with axes, shapes and placeholders."""
    odd = jax.tree.map(lambda _: leaf, MADE[name]())
    assert repr(odd).startswith(f"{name}(")
    Cells(odd._repr_html_())


@pytest.mark.parametrize("name", MADE)
def test_traced_values_are_shown_by_their_type(name: str) -> None:
    seen = []
    jax.jit(lambda thing: seen.append((repr(thing), thing._repr_html_())))(MADE[name](3))
    assert "Tracer" in seen[0][0]
    Cells(seen[0][1])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.25, "0.25"),
        (jnp.float64(1e-4), "0.0001"),
        ("midpoint", "'midpoint'"),
        (np.zeros((2, 3)), "<2×3 values, 0>"),
        (np.array([1.0, np.nan, 3.0]), "<3 values, 1 to 3, 1 not finite>"),
        (np.zeros(0), "<0 values>"),
        (np.nan, "nan"),
    ],
)
def test_value_takes_a_few_letters(value, text: str) -> None:
    assert value_text(value) == text


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (58.724, 6.04, "59 ± 6"),
        (1.0, 0.00019, "1.00000 ± 0.00019"),  # the excess over one is the result
        (3.4, 0.0997, "3.40 ± 0.10"),
        (0.5, 20.0, "0 ± 20"),
        (12345.0, 121.0, "12340 ± 120"),
        (1.23e7, 2e5, "(1.230 ± 0.020)e+07"),
        (-7.98e-7, 1e-6, "(-0.8 ± 1.0)e-06"),
        (np.nan, np.nan, "nan ± nan"),
    ],
)
def test_a_value_has_the_digits_that_its_error_leaves(value: float, error: float, text: str) -> None:
    assert with_error(value, error) == text


@given(st.floats(1e-12, 1e12), st.floats(1e-12, 1e12), st.sampled_from([-1, 1]))
def test_rounding_moves_a_value_by_less_than_its_error_and_the_error_by_a_seventh(value, error, sign) -> None:
    digits, _, power = with_error(sign * value, error).strip("(").partition(")e")
    shown, rounded_error = (float(x) * 10.0 ** int(power or 0) for x in digits.split(" ± "))
    assert rounded_error == pytest.approx(error, rel=1 / 7)
    assert abs(shown - sign * value) <= 0.51 * error + 5.1e-7 * value

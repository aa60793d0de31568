"""The replay page: its data, and what a real browser makes of it."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest

from tdanet_jax.analysis import replay, trace
from tdanet_jax.analysis.trace import Player
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.io import escaping
from tdanet_jax.scenes import camera_view
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.vocabulary import ROOM_TYPES
from tests.support import browser

#: Names as a hostile scene file could hold them.
HOSTILE = "</script><script>window.broken = 1</script>", "<img src=x onerror='window.broken = 2'>"


@pytest.fixture(scope="module")
def traces(opinionated_run, some_rooms):
    """A network and the shortest path in one episode."""
    player = trace.load_player(opinionated_run, Rooms(some_rooms, None))
    scene = some_rooms.scenes.index("FloorPlan229")
    goal = some_rooms.targets.index("Television")
    first = np.flatnonzero(some_rooms.position_scene == scene) * 16
    pose = first[some_rooms.distance[first, goal].argmax()]
    episode = Episodes(np.array([pose], np.int32), np.array([goal], np.int32))
    best = Player("shortest path", player.task)
    return [trace.play(who, some_rooms, episode, seed=2) for who in (player, best)]


def data_of(page):
    return json.loads(re.search(r'type="application/json">(.*?)</script>', page, re.S).group(1))


def test_the_page_of_a_house_names_the_room_in_which_the_episode_starts(traces, some_rooms):
    assert data_of(replay.page(traces, some_rooms))["room"] == "living room"
    types = some_rooms.position_room_type.copy()
    types[traces[0].pose[0] >> 4] = ROOM_TYPES.index("bathroom")
    house = dataclasses.replace(some_rooms, position_room_type=types)
    assert data_of(replay.page(traces, house))["room"] == "bathroom"


def test_the_page_holds_the_traces(traces, some_rooms):
    episode = data_of(replay.page(traces, some_rooms))
    assert (episode["scene"], episode["target"]) == ("FloorPlan229", "Television")
    assert episode["shortest"] == traces[0].shortest
    network, best = episode["players"]
    assert len(network["steps"]) == len(traces[0].actions) + 1
    for i, step in enumerate(network["steps"][:-1]):
        view = camera_view.of_pose(some_rooms, traces[0].pose[i])
        assert [box[0] for box in step["boxes"]] == list(view.classes)
        np.testing.assert_allclose(step["attention"], traces[0].attention[i], atol=1e-4)
        np.testing.assert_allclose(step["probabilities"], traces[0].probabilities[i], atol=1e-4)
        assert step["value"] == pytest.approx(traces[0].value[i], abs=1e-4)
        assert step["action"] == traces[0].actions[i]
        x, _, z = some_rooms.position[traces[0].pose[i] >> 4]
        assert step["place"] == [round(100 * x), round(-100 * z)]
    assert not {"action", "attention", "value"} & network["steps"][-1].keys()
    assert best["success"]
    assert not best["attends"]
    assert "probabilities" not in best["steps"][0]


def test_traces_of_different_episodes_are_refused(traces, some_rooms):
    other = dataclasses.replace(traces[1], target="Mug")
    with pytest.raises(ValueError, match="look for different targets"):
        replay.page([traces[0], other], some_rooms)


def test_no_name_ends_the_script():
    text = escaping.in_script({"name": HOSTILE[0], "entity": "&lt;", "line": "a\u2028b"})
    assert "<" not in text
    assert ">" not in text
    assert "&" not in text
    assert text.isascii()
    assert json.loads(text)["name"] == HOSTILE[0]


@pytest.fixture(scope="module")
def chromium():
    with browser.launch() as running:
        yield running


@pytest.fixture
def visit(chromium, tmp_path):
    """Opens a page that must log no errors and request no other file."""
    complaints, requests, contexts = [], [], []

    def opened(html, **options):
        path = tmp_path / "replay.html"
        path.write_text(html, encoding="utf-8")
        context = chromium.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        return page

    yield opened
    for context in contexts:
        context.close()
    assert complaints == []
    assert {url.rpartition("/")[2] for url in requests} == {"replay.html"}


def test_keys_buttons_and_slider_step_through_the_episode(visit, traces, some_rooms):
    page = visit(replay.page(traces, some_rooms))
    longest = max(len(made.actions) for made in traces)
    assert page.title() == "Television in FloorPlan229"
    count, slider = page.locator("#count"), page.locator("#slider")

    def at(step):
        assert slider.input_value() == str(step)
        said = "end" if step == longest else f"step {step + 1} of {longest}"
        assert count.text_content() == said

    at(0)
    page.keyboard.press("ArrowRight")
    at(1)
    page.get_by_role("button", name="Next step").click()
    at(2)
    page.keyboard.press("ArrowLeft")
    at(1)
    slider.focus()
    page.keyboard.press("ArrowRight")  # once, although the slider knows the key itself
    at(2)
    page.keyboard.press("End")
    at(longest)
    outcomes = [f"The end: {made.outcome}." for made in traces]
    assert page.locator(".doing").all_text_contents() == outcomes
    assert all(outcome in page.locator("#spoken").text_content() for outcome in outcomes)
    page.keyboard.press("Home")
    at(0)
    page.select_option("#speed", "10")
    page.get_by_role("heading", level=1).click()
    page.keyboard.press("Space")
    assert page.locator("#play").text_content() == "Pause"
    page.locator("#play", has_text="Play").wait_for(timeout=30_000)
    at(longest)


def test_each_step_shows_its_boxes_shades_and_probabilities(visit, traces, some_rooms):
    page = visit(replay.page(traces, some_rooms))
    network = page.locator(".player").first
    assert page.locator(".player").count() == 2
    assert "This agent has no attention" in page.locator(".player").nth(1).inner_text()
    for step in range(min(len(traces[0].actions), 12)):
        weights = traces[0].attention[step]
        shown = network.locator("svg.view rect").evaluate_all(
            "boxes => boxes.map(b => Number(b.getAttribute('fill-opacity')))"
        )
        np.testing.assert_allclose(sorted(shown), np.sort(0.85 * weights), atol=1e-3)
        view = camera_view.of_pose(some_rooms, traces[0].pose[step])
        sought = sum(name == "Television" for name in view.classes)
        assert network.locator("svg.view rect.target").count() == sought
        near = [n for n, ok in zip(view.classes, view.visible, strict=True) if ok]
        far = sought - near.count("Television")
        assert network.locator("svg.view rect.target.far").count() == far
        taken = network.locator("tr.taken")
        assert taken.count() == 1
        share = traces[0].probabilities[step, traces[0].actions[step]]
        number = taken.locator(".number").inner_text().replace("\u00a0", " ").split()[0]
        assert float(number) == pytest.approx(100 * share, abs=0.51)
        page.keyboard.press("ArrowRight")


#: Pairs of names of a picture that cover more than a fifth of the smaller one, and names cut off.
COVERED = """pictures => pictures.flatMap(picture => {
  const boxes = [...picture.querySelectorAll("text")].map(t => [t.textContent, t.getBBox()]);
  const view = picture.viewBox.baseVal;
  const out = boxes.filter(([, b]) => b.x < view.x - 1 || b.x + b.width > view.x + view.width + 3);
  const bad = out.map(([t]) => "cut off: " + t);
  boxes.forEach(([t, a], i) => boxes.slice(0, i).forEach(([u, b]) => {
    const w = Math.min(a.x + a.width, b.x + b.width) - Math.max(a.x, b.x);
    const h = Math.min(a.y + a.height, b.y + b.height) - Math.max(a.y, b.y);
    const least = Math.min(a.width * a.height, b.width * b.height);
    if (w > 0 && h > 0 && w * h > 0.2 * least) bad.push(t + " on " + u);
  }));
  return bad;
})"""


def test_it_fits_a_phone_in_light_and_dark_and_names_do_not_cover_each_other(
    visit, traces, some_rooms
):
    html = replay.page(traces, some_rooms)
    backs = set()
    for scheme, width in (("light", 390), ("dark", 390), ("light", 1366)):
        page = visit(html, viewport={"width": width, "height": 760}, color_scheme=scheme)
        assert page.evaluate("document.scrollingElement.scrollWidth") <= width
        backs.add(page.evaluate("getComputedStyle(document.body).backgroundColor"))
        for _ in range(4):
            assert page.locator("svg.plan, svg.view").evaluate_all(COVERED) == []
            page.keyboard.press("ArrowRight")
    assert len(backs) == 2


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (1920, 1080)])
@pytest.mark.parametrize("players", [1, 2, 3])
def test_actions_and_their_probabilities_stay_above_the_bar(
    visit, traces, some_rooms, players, width, height
):
    shown = [traces[0], *traces][:players]
    page = visit(replay.page(shown, some_rooms), viewport={"width": width, "height": height})
    assert page.locator(".player").count() == players
    bar = page.locator("nav").bounding_box()["y"]
    for row in page.locator("tr:has(.bar)").all():
        box = row.bounding_box()
        assert box["y"] + box["height"] <= bar
    pictures = page.locator("svg.plan, svg.view").all()
    assert min(picture.bounding_box()["height"] for picture in pictures) > 150


def test_everything_has_a_name_to_be_read_out(visit, traces, some_rooms):
    page = visit(replay.page(traces, some_rooms))
    nameless = page.evaluate(
        """[...document.querySelectorAll("button, input, select, svg[role=img]")].filter(e =>
        !(e.getAttribute("aria-label") || e.textContent.trim())).map(e => e.outerHTML)"""
    )
    assert nameless == []
    page.keyboard.press("Tab")
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid"


def test_hostile_names_are_shown_and_not_run(visit, traces, some_rooms):
    classes = list(some_rooms.classes)
    classes[classes.index("Sofa")], classes[classes.index("Television")] = HOSTILE
    renamed = dataclasses.replace(some_rooms, classes=tuple(classes))
    made = dataclasses.replace(traces[0], player=HOSTILE[0], target=HOSTILE[1])
    page = visit(replay.page([made], renamed))
    for _ in range(6):
        page.keyboard.press("ArrowRight")
    assert page.evaluate("window.broken") is None
    assert HOSTILE[0] in page.locator("h2").inner_text()
    assert HOSTILE[1] in page.locator("h1").inner_text()

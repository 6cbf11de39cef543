"""The page as a person uses it, in a real browser. Skips without one (Debian: apt-get install chromium)."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.keys import new_key
from tests.e2e.conftest import NOISY, Server, running_service

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium on this machine")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser: object, service: Server) -> Iterator[object]:
    with opened(browser, service) as page:
        yield page


@contextmanager
def opened(browser: object, service: Server) -> Iterator[object]:
    """The page; complains at the end about errors, and about requests to anywhere else."""
    page = browser.new_page(accept_downloads=True)  # type: ignore[attr-defined]
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    outside: list[str] = []
    page.on("request", lambda request: None if request.url.startswith(service.url) else outside.append(request.url))
    page.goto(service.url)
    yield page
    assert [text for text in complaints if "the server responded with a status of" not in text] == []
    assert [url for url in outside if not url.startswith("blob:")] == []
    page.close()


def test_a_scan_is_chosen_filtered_and_downloaded(page: object, tmp_path: Path) -> None:
    page.set_input_files("#file", NOISY)  # type: ignore[attr-defined]
    page.fill("#iterations", "1")  # type: ignore[attr-defined]
    page.click("#go")  # type: ignore[attr-defined]
    link = page.wait_for_selector("#download[href]", timeout=120_000)  # type: ignore[attr-defined]
    with page.expect_download() as download:  # type: ignore[attr-defined]
        link.click()
    assert download.value.suggested_filename == "bracket_noisy_filtered.ply"
    saved = tmp_path / "saved.ply"
    download.value.save_as(saved)
    assert saved.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert saved.stat().st_size > NOISY.stat().st_size


def test_a_wrong_file_is_explained_in_plain_words(page: object, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.ply"
    wrong.write_text("hello, I am no scan\n")
    page.set_input_files("#file", wrong)  # type: ignore[attr-defined]
    page.click("#go")  # type: ignore[attr-defined]
    told = page.wait_for_selector("#problem:not([hidden])", timeout=30_000).inner_text()  # type: ignore[attr-defined]
    assert "not a PLY file" in told
    assert page.is_hidden("#result")  # type: ignore[attr-defined]


def test_it_says_how_far_it_is_and_stops_when_told(page: object, service: Server) -> None:
    page.set_input_files("#file", NOISY)  # type: ignore[attr-defined]
    page.fill("#iterations", "10")  # type: ignore[attr-defined]
    with page.expect_response(lambda answer: "/jobs?" in answer.url) as answer:  # type: ignore[attr-defined]
        page.click("#go")  # type: ignore[attr-defined]
    href = answer.value.headers["location"]
    page.wait_for_selector("#status:has-text('pass 1 of 10')", timeout=60_000)  # type: ignore[attr-defined]
    assert 0 <= float(page.get_attribute("#progress", "value")) < 1  # type: ignore[attr-defined]
    page.click("#stop")  # type: ignore[attr-defined]
    page.wait_for_selector("#status:has-text('Stopped.')")  # type: ignore[attr-defined]
    for _ in range(100):
        if (state := service.get(href).json()["state"]) == "cancelled":
            break
        page.wait_for_timeout(100)  # type: ignore[attr-defined]
    assert state == "cancelled"
    assert page.is_hidden("#result")  # type: ignore[attr-defined]


def test_it_asks_for_a_key_where_one_is_needed(browser: object, tmp_path: Path) -> None:
    key, line = new_key("ann")
    (tmp_path / "keys").write_text(line + "\n")
    with (
        running_service(tmp_path, POINTFILTER_KEYS_FILE=str(tmp_path / "keys")) as (service, _),
        opened(browser, service) as page,
    ):
        assert page.is_hidden("#key")  # type: ignore[attr-defined]
        page.set_input_files("#file", NOISY)  # type: ignore[attr-defined]
        page.fill("#iterations", "1")  # type: ignore[attr-defined]
        page.click("#go")  # type: ignore[attr-defined]
        assert "API key" in page.wait_for_selector("#problem:not([hidden])").inner_text()  # type: ignore[attr-defined]
        page.fill("#key", key)  # type: ignore[attr-defined]
        page.click("#go")  # type: ignore[attr-defined]
        page.wait_for_selector("#download[href]", timeout=120_000)  # type: ignore[attr-defined]

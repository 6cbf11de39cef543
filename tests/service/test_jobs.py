"""Jobs: accepted ones are never lost, run once at a time, say how far they are, and stop when told to."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.app import create_app
from service.errors import UnauthorizedError
from service.job import Job
from service.jobs import Jobs
from service.keys import Keys, KeysError, new_key, read_keys
from service.records import Record, State
from service.runner import MOST_ATTEMPTS
from service.settings import Settings
from service.work import Order, is_small
from tests.service.apps import Gate, house_of, metric, until
from tests.service.test_refusals import check


def begin(client: TestClient, content: bytes, path: str = "/jobs", **more: Any) -> str:
    """The address of an accepted job."""
    answer = client.post(path, content=content, **more)
    assert answer.status_code == 202, answer.text
    assert answer.json()["state"] == "queued"
    location: str = answer.headers["location"]
    assert location == f"/jobs/{answer.json()['id']}" == answer.json()["href"]
    return location


def ended(client: TestClient, location: str) -> dict[str, Any]:
    answer = client.get(f"{location}?wait=30")
    assert answer.status_code == 200
    assert answer.json()["finished"]
    found: dict[str, Any] = answer.json()
    return found


def test_a_job_gives_what_a_request_gives(client: TestClient, ply: bytes, data_dir: Path) -> None:
    query = "?iterations=2&radius=20%25&seed=5&strength=0.75&max_move=0.02&normals=drop&columns=displacement"
    direct = client.post(f"/filter{query}", files={"file": ("scan.ply", ply)})
    answer = client.post(f"/jobs{query}", files={"file": ("scan.ply", ply)})
    location = answer.headers["location"]
    status = ended(client, location)
    assert (status["state"], status["attempts"], status["problem"]) == ("done", 1, None)
    assert status["expires"] > status["finished"] >= status["started"] >= status["created"]
    result = client.get(status["result"])
    assert result.content == direct.content
    names = ("content-disposition", "x-model", "x-points", "x-iterations", "x-moved", "x-radius", "etag",
             "content-type", "content-length")  # fmt: skip
    assert {name: result.headers[name] for name in names} == {name: direct.headers[name] for name in names}
    assert result.headers["server-timing"].startswith("queue;dur=")
    (folder,) = (data_dir / "jobs").iterdir()
    assert not (folder / "input.ply").exists()  # not kept longer than it is needed
    until(lambda: metric(client, "pointfilter_jobs_total", model="tiny", outcome="ok") == 1)  # counted once it is told
    assert metric(client, "pointfilter_points_total", model="tiny") == 1000


def test_the_page_of_a_request_may_ask_for_a_job(client: TestClient, ply: bytes) -> None:
    for preference in ("respond-async", 'return=minimal, Respond-Async; foo="bar", wait=10'):
        location = begin(client, ply, "/filter", headers={"Prefer": preference})
        assert ended(client, location)["state"] == "done"
    assert client.post("/filter", content=ply, headers={"Prefer": "return=minimal"}).status_code == 200


def test_a_file_too_large_for_one_request_becomes_a_job(
    make_client: Callable[..., TestClient], ply: bytes, temp_dir: Path
) -> None:
    client = make_client(sync_bytes=len(ply) - 1)
    location = begin(client, ply, "/filter")
    assert ended(client, location)["state"] == "done"
    until(lambda: not list(temp_dir.iterdir()))
    assert metric(client, "pointfilter_requests_total", model="tiny", outcome="ok") == 0


@pytest.mark.parametrize(
    ("content", "query", "status", "code"),
    [(b"no ply", "", 415, "unsupported-format"), (b"ply\nformat ascii 1.0\nend", "", 400, "malformed-file")],
)
def test_a_job_that_fails_says_why(
    client: TestClient, data_dir: Path, content: bytes, query: str, status: int, code: str
) -> None:
    location = begin(client, content, f"/jobs{query}", headers={"X-Request-ID": "mine"})
    found = ended(client, location)
    assert (found["state"], found["result"]) == ("failed", None)
    problem = check(client.get(f"{location}/result"), status, code)
    assert problem | {"request_id": "mine", "instance": f"{location}#mine"} == found["problem"]
    (folder,) = (data_dir / "jobs").iterdir()
    assert {path.name for path in folder.iterdir()} == {"job.json", "lock"}


@pytest.mark.parametrize(
    ("path", "content", "status", "code"),
    [
        ("/jobs?iterations=0", b"ply", 422, "parameter-out-of-range"),
        ("/jobs?model=nobody", b"ply", 404, "model-not-found"),
        ("/jobs", b"", 400, "malformed-request"),
    ],
)
def test_what_can_be_refused_at_once_is_no_job(
    client: TestClient, data_dir: Path, path: str, content: bytes, status: int, code: str
) -> None:
    check(client.post(path, content=content), status, code)
    assert list((data_dir / "jobs").iterdir()) == list((data_dir / "incoming").iterdir()) == []


@pytest.mark.parametrize("name", ["0" * 32, "A" * 32, "..%2Fjobs", "x", "0" * 31])
def test_names_that_are_no_job(client: TestClient, name: str) -> None:
    for path in (f"/jobs/{name}", f"/jobs/{name}/result", f"/jobs/{name}/events"):
        code = "not-found" if "%2F" in name else "job-not-found"
        check(client.get(path), 404, code)
    if "%2F" not in name:
        check(client.delete(f"/jobs/{name}"), 404, "job-not-found")


def test_cancelling_stops_the_work(client: TestClient, gate: Gate, ply: bytes, data_dir: Path) -> None:
    running, queued = begin(client, ply), begin(client, ply)
    until(lambda: gate.entered == 1)
    assert client.get(running).json()["state"] == "running"
    assert metric(client, "pointfilter_jobs_running") == 1
    check(client.get(f"{running}/result"), 409, "job-not-finished")
    for location, stopped in ((queued, 0), (running, 1)):
        started = time.monotonic()
        assert client.delete(location).status_code == 204
        assert time.monotonic() - started < 2
        assert gate.stopped == stopped
        assert client.get(location).json()["state"] == "cancelled"
        check(client.get(f"{location}/result"), 410, "job-cancelled")
        left = {path.name for path in (data_dir / location[1:]).iterdir()}
        assert left <= {"job.json", "lock", "cancel"}
    gate.open.set()
    later = begin(client, ply)
    assert ended(client, later)["state"] == "done"  # the worker is free again, and nobody does the cancelled ones
    assert gate.entered == 2
    assert client.delete(later).status_code == 204
    check(client.get(later), 404, "job-not-found")


def test_a_job_that_takes_too_long_is_stopped(make_client: Callable[..., TestClient], gate: Gate, ply: bytes) -> None:
    client = make_client(job_seconds=0.2)
    found = ended(client, begin(client, ply))
    assert (found["state"], found["problem"]["code"]) == ("failed", "deadline-exceeded")
    assert "POINTFILTER_JOB_SECONDS" in found["problem"]["hint"]
    assert gate.stopped == 1
    until(lambda: metric(client, "pointfilter_jobs_total", model="tiny", outcome="timeout") == 1)


def test_the_end_of_the_process_loses_no_job(make_settings: Callable[..., Settings], gate: Gate, ply: bytes) -> None:
    with TestClient(create_app(make_settings(drain_seconds=0))) as client:
        until(lambda: client.get("/health/ready").status_code == 200)
        jobs = [begin(client, ply) for _ in range(3)]
        until(lambda: gate.entered == 1)
    assert gate.stopped == 1
    gate.open.set()
    with TestClient(create_app(make_settings())) as client:
        until(lambda: client.get("/health/ready").status_code == 200)
        statuses = [ended(client, location) for location in jobs]
        assert [status["state"] for status in statuses] == ["done"] * 3
        assert [status["attempts"] for status in statuses] == [1, 1, 1]  # a stop that was asked for does not count
        results = {client.get(f"{location}/result").content for location in jobs}
        assert results == {client.post("/filter", content=ply).content}


def test_a_draining_process_finishes_its_job_and_begins_no_other(
    make_settings: Callable[..., Settings], gate: Gate, ply: bytes, data_dir: Path
) -> None:
    app = create_app(make_settings(drain_seconds=30))
    with TestClient(app) as client:
        until(lambda: client.get("/health/ready").status_code == 200)
        for _ in range(2):
            begin(client, ply)
        until(lambda: gate.entered == 1)
        app.state.house.drain()
        check(client.post("/jobs", content=ply), 503, "draining")
        gate.open.set()
    states = sorted(record.state for _, record in Jobs(data_dir).all())
    assert states == [State.DONE, State.QUEUED]


def test_two_processes_share_the_jobs(make_settings: Callable[..., Settings], gate: Gate, ply: bytes) -> None:
    with TestClient(create_app(make_settings())) as one, TestClient(create_app(make_settings())) as two:
        for client in (one, two):
            until(lambda client=client: client.get("/health/ready").status_code == 200)  # type: ignore[misc]
        jobs = [begin(one, ply) for _ in range(4)]
        until(lambda: gate.entered == 2, 10)  # each has one worker
        assert two.delete(jobs[0]).status_code == 204  # whoever works on it
        assert one.get(jobs[0]).json()["state"] == "cancelled"
        gate.open.set()
        assert [ended(two, location)["state"] for location in jobs[1:]] == ["done"] * 3
        assert gate.entered == 4
        assert gate.stopped == 1


def test_a_full_queue_refuses(make_client: Callable[..., TestClient], gate: Gate, ply: bytes) -> None:
    client = make_client(job_queue_size=2)
    begin(client, ply)
    until(lambda: gate.entered == 1)
    last = [begin(client, ply) for _ in range(2)][-1]
    refused = client.post("/jobs", content=ply)
    problem = check(refused, 429, "jobs-full")
    assert (problem["limit"], problem["actual"]) == (2, 3)
    assert int(refused.headers["retry-after"]) >= 1
    assert "POINTFILTER_JOB_QUEUE_SIZE" in str(problem["hint"])
    assert metric(client, "pointfilter_requests_total", model="tiny", outcome="rejected") == 1
    assert client.delete(last).status_code == 204  # makes room at once
    begin(client, ply)
    gate.open.set()


def test_a_cloud_is_small_by_its_points(tmp_path: Path, ply: bytes) -> None:
    path = tmp_path / "cloud.ply"
    for content, points, small in (
        (ply, 500, True),
        (ply, 499, False),
        (b"no ply", 1, True),  # refused at once
        (ply.replace(b"end_header", b"comment " + b"x" * 100_000 + b"\nend_header"), 500, False),
        (ply + bytes(600_000), 500, False),  # who knows what that is
    ):
        path.write_bytes(content)
        assert is_small(path, points) is small


def test_progress_as_it_happens(make_client: Callable[..., TestClient], gate: Gate, ply: bytes) -> None:
    client = make_client()
    location = begin(client, ply, "/jobs?iterations=3")
    until(lambda: gate.entered == 1)
    job = Job(house_of(client).settings.job_folder / location[1:])
    (job.folder / "progress.json").write_text('{"done": 700, "total": 1500, "points": 500, "seconds": 7}')
    found = client.get(location).json()["progress"]
    assert found == {
        "points_done": 200, "points": 500, "iteration": 2, "iterations": 3, "share": 0.4667, "seconds_left": 8.0,
    }  # fmt: skip
    gate.open.set()
    with client.stream("GET", f"{location}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        events = list(parsed(stream.iter_lines()))
    assert [name for name, _ in events[:-1]] == ["progress"] * (len(events) - 1)
    name, last = events[-1]
    assert (name, last["state"], last["result"]) == ("done", "done", f"{location}/result")
    assert last["progress"]["share"] == 1
    assert last["progress"]["points_done"] == last["progress"]["points"] == 500


def parsed(lines: Iterator[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    name = ""
    for line in lines:
        if line.startswith("event: "):
            name = line.removeprefix("event: ")
        if line.startswith("data: "):
            yield name, json.loads(line.removeprefix("data: "))


def test_a_job_that_ends_every_process_is_given_up(client: TestClient, gate: Gate, ply: bytes, data_dir: Path) -> None:
    begin(client, ply)
    until(lambda: gate.entered == 1)
    jobs = Jobs(data_dir)
    poison = accepted(jobs)
    poison.source.write_bytes(ply)
    poison.write(poison.read().model_copy(update={"attempts": MOST_ATTEMPTS, "state": State.RUNNING}))
    gate.open.set()
    found = ended(client, f"/jobs/{poison.id}")
    assert (found["state"], found["problem"]["code"]) == ("failed", "worker-died")
    assert gate.entered == 1


def test_jobs_that_ended_go_after_a_while(client: TestClient, ply: bytes, data_dir: Path) -> None:
    location = begin(client, ply)
    ended(client, location)
    jobs = house_of(client).jobs
    assert jobs.expire(3600, 3600) == 0
    incoming = jobs.begin()
    assert jobs.expire(0, 3600) == 1
    check(client.get(location), 404, "job-not-found")
    assert incoming.folder.exists()
    jobs.expire(0, 0)
    assert list((data_dir / "jobs").iterdir()) == list((data_dir / "incoming").iterdir()) == []


# API keys ----------------------------------------------------------------------------------------------------------


@contextmanager
def keyed(make_client: Callable[..., TestClient], folder: Path, **settings: Any) -> Iterator[tuple[TestClient, Any]]:
    """A client of an app that wants keys, and the headers of two callers."""
    made = {name: new_key(name) for name in ("ann", "ben")}
    path = folder / "keys"
    path.write_text("# who may filter\n\n" + "".join(f"{line}\n" for _, line in made.values()))
    yield (
        make_client(keys_file=path, **settings),
        {name: {"Authorization": f"Bearer {key}"} for name, (key, _) in made.items()},
    )


def test_without_a_key_nothing_is_filtered(make_client: Callable[..., TestClient], tmp_path: Path, ply: bytes) -> None:
    with keyed(make_client, tmp_path) as (client, headers):
        for given in ({}, {"Authorization": "Bearer x"}, {"Authorization": headers["ann"]["Authorization"][7:]}):
            for path in ("/filter", "/jobs"):
                answer = client.post(path, content=ply, headers=given)
                check(answer, 401, "unauthorized")
                assert answer.headers["www-authenticate"] == "Bearer"
            check(client.get(f"/jobs/{'0' * 32}", headers=given), 401, "unauthorized")
        assert client.post("/filter", content=ply, headers=headers["ann"]).status_code == 200
        assert client.get("/health/ready").status_code == 200


def test_keys_come_and_go_with_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.keys.LOOK_SECONDS", 0.0)
    path = tmp_path / "keys"
    (old, old_line), (new, new_line) = new_key("ann"), new_key("ann")
    path.write_text(old_line)
    keys = Keys(path)
    assert keys.caller(f"Bearer {old}") == "ann"
    path.write_text(f"{old_line}\n{new_line}")
    assert keys.caller(f"bearer {new}") == keys.caller(f"Bearer {old}") == "ann"
    path.write_text(f"{new_line}\nwhat is this")
    assert keys.caller(f"Bearer {old}") == "ann"
    assert "line 2" in caplog.text  # whoever wanted the old key gone must know that it is not
    path.write_text(f"{new_line}\n")
    with pytest.raises(UnauthorizedError):
        keys.caller(f"Bearer {old}")
    path.write_text("ann x")
    with pytest.raises(KeysError, match="line 1"):
        read_keys(path)


def test_jobs_are_their_owner_s(make_client: Callable[..., TestClient], tmp_path: Path, ply: bytes) -> None:
    with keyed(make_client, tmp_path) as (client, headers):
        location = begin(client, ply, headers=headers["ann"])
        for path in ("", "/result", "/events"):
            check(client.get(f"{location}{path}", headers=headers["ben"]), 404, "job-not-found")
        check(client.delete(location, headers=headers["ben"]), 404, "job-not-found")
        assert client.get(f"{location}?wait=30", headers=headers["ann"]).json()["state"] == "done"


def test_a_key_has_its_own_limits(
    make_client: Callable[..., TestClient], tmp_path: Path, gate: Gate, ply: bytes
) -> None:
    with keyed(make_client, tmp_path, jobs_per_key=1, places_per_key=1) as (client, headers):
        begin(client, ply, headers=headers["ann"])
        until(lambda: gate.entered == 1)
        problem = check(client.post("/jobs", content=ply, headers=headers["ann"]), 429, "jobs-full")
        assert (problem["limit"], problem["actual"]) == (1, 2)
        begin(client, ply, headers=headers["ben"])
        with house_of(client).admission.place("ann"):
            problem = check(client.post("/filter", content=ply, headers=headers["ann"]), 429, "queue-full")
            assert (problem["limit"], problem["actual"]) == (1, 2)
            assert "POINTFILTER_PLACES_PER_KEY" in str(problem["hint"])
        gate.open.set()


# The folder --------------------------------------------------------------------------------------------------------


def accepted(jobs: Jobs, name: str = "", **values: Any) -> Job:
    incoming = jobs.begin()
    incoming.source.write_bytes(b"ply")
    order = Order("tiny", None, None, 0, "same")
    return jobs.accept(incoming, Record(id=incoming.id, created=0, order=order, request_id=name, **values))


def test_a_job_of_an_earlier_version_is_done(
    make_settings: Callable[..., Settings], data_dir: Path, ply: bytes
) -> None:
    job = accepted(Jobs(data_dir))
    job.source.write_bytes(ply)
    (job.folder / "job.json").write_text(json.dumps({
        "id": job.id, "state": "queued", "created": time.time(), "started": None, "finished": None, "attempts": 0,
        "order": {"model": "tiny", "iterations": "auto", "radius": None, "seed": 0, "encoding": "same"},
        "file_name": None, "small": False, "owner": None, "request_id": "r", "outcome": None, "problem": None,
    }))  # fmt: skip
    with TestClient(create_app(make_settings())) as client:
        until(lambda: client.get("/health/ready").status_code == 200)
        assert ended(client, f"/jobs/{job.id}")["state"] == "done"
        result = client.get(f"/jobs/{job.id}/result")
        assert result.content == client.post("/filter", content=ply).content


def test_a_result_of_an_earlier_version_can_be_fetched(client: TestClient, ply: bytes, data_dir: Path) -> None:
    location = begin(client, ply)
    ended(client, location)
    path = data_dir / location[1:] / "job.json"
    record = json.loads(path.read_text())
    record["order"] = {name: record["order"][name] for name in ("model", "radius", "seed", "encoding")}
    record["order"]["iterations"] = "auto"
    names = ("sha256", "size", "points", "iterations", "model", "seconds")
    record["outcome"] = {name: record["outcome"][name] for name in names}
    path.write_text(json.dumps(record))
    result = client.get(f"{location}/result")
    assert result.status_code == 200
    assert result.headers["x-iterations"] == "2"
    assert "x-moved" not in result.headers


def test_first_in_first_out_and_small_ones_by_themselves(data_dir: Path) -> None:
    jobs = Jobs(data_dir)
    large = [accepted(jobs).id for _ in range(3)]
    small = [accepted(jobs, small=True).id for _ in range(2)]
    assert (jobs.queued(False), jobs.queued(True), jobs.waiting()) == (3, 2, 5)
    again = Jobs(data_dir)  # another process
    assert [job.id for job in (again.next(False), jobs.next(False), again.next(False)) if job] == large
    assert [job.id for job in (again.next(True), again.next(True)) if job] == small
    assert jobs.next(True) is None


def test_a_job_that_nobody_works_on_is_found_again(data_dir: Path) -> None:
    jobs = Jobs(data_dir)
    job = accepted(jobs)
    assert jobs.recover() == 0  # it is in the queue
    taken = jobs.next(False)
    assert taken is not None
    with taken.locked() as ours, job.locked() as theirs:
        assert (ours, theirs) == (True, False)
        assert jobs.recover() == 0  # somebody works on it
    assert jobs.recover() == 1
    job.write(job.read().model_copy(update={"state": State.DONE}))
    assert jobs.next(False) is not None
    assert jobs.recover() == 0  # nothing left to do


def test_a_record_is_whole_or_not_there(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = Jobs(data_dir)
    job = accepted(jobs, "before")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="No space"):
        job.write(job.read().model_copy(update={"request_id": "after"}))
    assert job.read().request_id == "before"
    assert {path.name for path in job.folder.iterdir()} == {"job.json", "input.ply"}
    with pytest.raises(OSError, match="No space"):
        accepted(jobs)
    assert len(list(jobs.all())) == 1


def test_a_folder_that_cannot_be_written_to_is_known_at_the_start(
    make_settings: Callable[..., Settings], tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    with TestClient(create_app(make_settings(data_dir=tmp_path / "file"))) as client:
        until(lambda: "failed" in client.get("/health/ready").text)

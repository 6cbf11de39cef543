"""The workers (worker.py) as the service sees them: always as many as there should be, each busy or free.

One that dies is replaced, and what it was at is done again; one that does not stop when told to is killed.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from queue import Empty, SimpleQueue

from pointfilter.errors import FilteringCancelledError
from pointfilter.inspection import Look
from service import worker
from service.errors import WorkerDiedError
from service.exchange import current_request_id
from service.hands import Hand, start_process
from service.settings import Settings
from service.work import Delivery, LookOrder, Order

log = logging.getLogger("service.workers")

ATTEMPTS = 3  # a file that kills three workers is not tried on a fourth
START_SECONDS = 120.0  # the longest that a worker may take until its model has answered
STOP_SECONDS = 0.5  # from the word to the kill
RETRY_SECONDS = 10
LOOK_SECONDS = 0.05  # how often a waiting thread looks whether it shall stop


class Crew:
    """As many workers as requests may be worked on at once.

    Its methods block: call them off the event loop. on_models is called, from any thread, with the models in the
    workers' memory whenever they change; on_failure when a worker cannot be replaced.
    """

    def __init__(
        self,
        settings: Settings,
        size: int,
        on_models: Callable[[list[worker.Loaded]], None] = lambda _: None,
        on_failure: Callable[[Exception], None] = lambda _: None,
        on_death: Callable[[], None] = lambda: None,
    ) -> None:
        self._settings = settings
        self._size = size
        self._on_models = on_models
        self._on_failure = on_failure
        self._on_death = on_death
        self._hands: list[Hand] = []
        self._free: SimpleQueue[Hand] = SimpleQueue()
        self._lock = threading.Lock()
        self._closed = False

    def open(self) -> None:
        """Starts the workers and waits until the default model has answered in each.

        Raises what a worker raised at that, or WorkerDiedError.
        """
        starting = [self._start() for _ in range(self._size)]
        for hand in starting:
            self._greet(hand)
            self._free.put(hand)

    def close(self) -> None:
        """Ends all workers, what they are at included."""
        with self._lock:
            self._closed = True
            hands, self._hands = self._hands, []
        for hand in hands:
            hand.end()

    def loaded(self) -> list[worker.Loaded]:
        """The models in the workers' memory, each once."""
        with self._lock:
            return list(dict.fromkeys(model for hand in self._hands for model in hand.loaded))

    def memory(self) -> int:
        """Resident bytes of all workers, where the system tells (/proc)."""
        with self._lock:
            numbers = [hand.pid for hand in self._hands]
        total = 0
        for number in numbers:
            with suppress(OSError, ValueError, IndexError):
                total += int(Path(f"/proc/{number}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        return total

    def carry_out(
        self,
        order: Order,
        source: Path,
        target: Path,
        stop: threading.Event,
        progress: Callable[[int, int, int], None] = lambda _done, _total, _points: None,
    ) -> Delivery:
        """work.carry_out by a free worker; there must be one, so hold a slot of Admission.

        Raises what the work raised, and WorkerDiedError when workers died of it.
        """
        delivery = self._have_done(worker.Task(order, source, target, current_request_id.get()), stop, progress)
        assert isinstance(delivery, Delivery)  # noqa: S101 - what an Order gives
        return delivery

    def look(self, order: LookOrder, source: Path, stop: threading.Event) -> Look:
        """work.look_over by a free worker, as carry_out does it."""
        task = worker.Task(order, source, None, current_request_id.get())
        looked = self._have_done(task, stop, lambda _done, _total, _points: None)
        assert isinstance(looked, Look)  # noqa: S101 - what a LookOrder gives
        return looked

    def _have_done(
        self, task: worker.Task, stop: threading.Event, progress: Callable[[int, int, int], None]
    ) -> Delivery | Look:
        attempt = 0
        while attempt < ATTEMPTS:
            hand = self._take(stop)
            try:
                hand.connection.send(task)
            except (OSError, ValueError):  # it was dead before
                self._retire(hand)
                continue
            attempt += 1
            try:
                answer = self._converse(hand, stop, progress)
            except (EOFError, OSError, ValueError):
                self._retire(hand, attempt)
                continue
            except BaseException:
                self._retire(hand, attempt)  # nobody knows what it will say next
                raise
            self._free.put(hand)
            if isinstance(answer, worker.Failed):
                raise answer.error
            self._note(hand, answer.loaded)
            return answer.result
        raise WorkerDiedError(
            f"{ATTEMPTS} workers died of this file, one after the other", limit=ATTEMPTS, retry_after=RETRY_SECONDS
        )

    def mend(self) -> None:
        """Replaces free workers that died. To be called now and then."""
        for _ in range(self._free.qsize()):
            try:
                hand = self._free.get_nowait()
            except Empty:
                return
            if _silent(hand.connection):
                self._free.put(hand)
            else:
                self._retire(hand)

    def _take(self, stop: threading.Event) -> Hand:
        while not stop.is_set():
            with suppress(Empty):
                return self._free.get(timeout=LOOK_SECONDS)
        raise FilteringCancelledError("the work was stopped")

    def _converse(
        self, hand: Hand, stop: threading.Event, progress: Callable[[int, int, int], None]
    ) -> worker.Done | worker.Failed:
        """Raises EOFError or OSError when the worker died, or was killed because it did not stop."""
        told: float | None = None
        while True:
            if stop.is_set():
                if told is None:
                    told = time.monotonic()
                    hand.connection.send(worker.Stop())
                elif time.monotonic() - told > STOP_SECONDS:
                    hand.kill()
                    raise EOFError
            if hand.connection.poll(LOOK_SECONDS):
                message = hand.connection.recv()
                if isinstance(message, worker.Progress):
                    progress(message.done, message.total, message.points)
                elif isinstance(message, worker.Done | worker.Failed):
                    return message

    def _retire(self, hand: Hand, attempt: int = 1) -> None:
        """Has a dead worker replaced, in a thread of its own: nobody has to wait for the new one's start."""
        log.warning("a worker died and is replaced", extra={"attempt": attempt})
        self._on_death()
        hand.end()
        with self._lock:
            if hand in self._hands:
                self._hands.remove(hand)
        threading.Thread(target=self._replace, args=(hand,), name="replace", daemon=True).start()

    def _replace(self, dead: Hand) -> None:
        new = dead  # whoever takes it will find it dead and have it replaced again
        try:
            new = self._start()
            self._greet(new)
        except Exception as error:  # noqa: BLE001 - whatever it is, the service must know
            if not self._closed:
                self._on_failure(error)
        finally:
            self._free.put(new)

    def _start(self) -> Hand:
        with self._lock:
            if self._closed:
                raise WorkerDiedError("the service is ending")
            hand = start_process(self._settings)
            self._hands.append(hand)
        return hand

    def _greet(self, hand: Hand) -> None:
        try:
            up = hand.connection.recv() if hand.connection.poll(START_SECONDS) else None
        except (EOFError, OSError):
            up = None
        if isinstance(up, worker.Failed):
            raise up.error
        if not isinstance(up, worker.Up):
            raise WorkerDiedError("a worker died at its start, or did not get ready in time", limit=START_SECONDS)
        self._note(hand, up.loaded)

    def _note(self, hand: Hand, loaded: tuple[worker.Loaded, ...]) -> None:
        if loaded != hand.loaded:
            hand.loaded = loaded
            self._on_models(self.loaded())


def _silent(connection: Connection) -> bool:
    """A free worker has nothing to say: something to read is its end."""
    try:
        return not connection.poll()
    except OSError:
        return False

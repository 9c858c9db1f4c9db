"""SIGINT, SIGTERM and SIGHUP end a command in two seconds, with one line on the results that were written or kept."""

import atexit
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
PATIENCE = 1.0
"""Time (s) for a command to end by itself. A command within a long library call, such as a compiler, cannot."""
REMINDERS = 10  # signals that are sent again to the main thread meanwhile
WITH_INPUT = "COOPENV_END_WITH_INPUT"
"""Environment variable of a process that ends as soon as its standard input does."""
HIDDEN_CURSOR_BACK = "\x1b[?25h"

_received = 0
_holds: list[None] = []
NOTHING = "nothing written"
_state = NOTHING
_kept: list[Callable[[], str]] = []
_ended = threading.Event()
_last_steps: list[Callable[[], None]] = []


class Interrupted(KeyboardInterrupt):
    """A signal has asked the command to end."""


def install() -> None:
    """Catch the signals of this process, a command that ends with its work: they raise `Interrupted`.

    They are not ignored in the background of a shell script, unlike what the shell asks for: `kill -INT` works there.
    After `nohup`, SIGHUP is: a command that is to outlive its terminal does.
    """
    signals, waker = socket.socketpair()
    waker.setblocking(False)
    signal.set_wakeup_fd(waker.detach(), warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(signals,), daemon=True).start()
    for number in SIGNALS:
        if number in SIGNALS[:2] or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)
    if os.environ.pop(WITH_INPUT, ""):
        threading.Thread(target=_end_with_input, daemon=True).start()


def _end_with_input() -> None:
    """End this process as SIGTERM does once its standard input is closed: its parent has ended, in any way."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def received() -> bool:
    """Return whether a signal has asked the command to end."""
    return _received != 0


@contextmanager
def held() -> Iterator[None]:
    """Delay an interruption to the end of the block, which must not be left half done."""
    _holds.append(None)
    try:
        yield
    finally:
        _holds.pop()
    if _received and not _holds and threading.current_thread() is threading.main_thread():
        raise Interrupted


def note(state: str) -> None:
    """Set the line on the results that an interruption from now on prints."""
    global _state
    _state = state


def also_kept(words: Callable[[], str]) -> None:
    """Append a text on further kept files to the line of an interruption; empty: none."""
    _kept.append(words)


def before_a_hard_end(step: Callable[[], None]) -> None:
    """Register a step that another thread takes before it ends a command that does not end by itself."""
    _last_steps.append(step)


def report() -> int:
    """Print the line on the results and return the exit status, 128 and the number of the signal."""
    _ended.set()
    if sys.stderr is not None:
        with suppress(OSError):
            print(_summary(), file=sys.stderr, flush=True)
    return 128 + (_received or signal.SIGINT)


def end(status: int) -> NoReturn:
    """End the process without taking the interpreter apart, which takes long with large libraries."""
    with suppress(OSError, AttributeError):
        sys.stdout.flush()
    atexit._run_exitfuncs()
    os._exit(status)


def end_with_parent() -> None:
    """End this process, one that `multiprocessing` has started, as soon as its parent has ended in any way."""
    from multiprocessing import parent_process
    from multiprocessing.connection import wait

    parent = parent_process()
    if parent is not None:

        def wait_and_end() -> None:
            wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=wait_and_end, daemon=True).start()


def _summary() -> str:
    kept = [text for words in _kept if (text := words())]
    results = [] if kept and _state == NOTHING else [_state]
    return f"interrupted; {'; '.join([*results, *kept])}"


def _handle(number: int, _frame: object) -> None:
    global _received
    _received = number
    for each in SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    sys.unraisablehook = lambda _: None  # exceptions that cannot be caught are not printed; see _watch
    if not _holds:
        raise Interrupted


def _watch(signals: socket.socket) -> None:
    """End the process if it does not do so by itself; runs also while the main thread is in a library's call."""
    number = 0
    while number not in SIGNALS:
        number = signals.recv(1)[0]
    for _ in range(REMINDERS):
        if _ended.wait(PATIENCE / REMINDERS):
            time.sleep(PATIENCE / 2)  # for what libraries do at the end
            break
        if hasattr(signal, "pthread_kill"):  # a thread that was about to wait for a lock has slept through the first
            signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        for step in _last_steps:
            step()
        shown = HIDDEN_CURSOR_BACK if os.isatty(2) else ""
        with suppress(OSError):
            os.write(2, f"{shown}{_summary()}\n".encode())
    os._exit(128 + number)

"""Ctrl-C, wherever it strikes: one line, exit status 130, and soon."""

import signal
import subprocess
import sys
import threading
import time

import pytest

from jaxtrapolate.commands.interrupt import interruptible

MESSAGE = "jaxtrapolate: interrupted; run again to go on\n"
PROGRAM = """
import gc, hashlib, os, signal, sys, threading, time
from jaxtrapolate.commands import interrupt
interrupt._PATIENCE = 1.0
strike = lambda: os.kill(os.getpid(), signal.SIGINT)
class Finaliser:
    def __del__(self): strike(); sum(range(1000))
def callback(phase, info):
    if phase == "start" and info["generation"] == 2: strike(); sum(range(1000))
try:
    with interrupt.interruptible():
        {body}
except KeyboardInterrupt:
    print("jaxtrapolate: interrupted; run again to go on", file=sys.stderr)
    sys.exit(130)
"""
CASES = {
    "in plain code": "strike(); time.sleep(20)",
    "in a callback of the garbage collector": "gc.callbacks.append(callback); gc.collect(); gc.callbacks.clear(); "
    "time.sleep(20)",
    "in a finaliser": "Finaliser(); time.sleep(20)",
    "in code that no signal reaches": "threading.Timer(0.2, strike).start(); "
    "hashlib.pbkdf2_hmac('sha256', b'', b'', 60_000_000)",
    "in code that goes on whatever happens": """
        while True:
            try: strike(); time.sleep(20)
            except KeyboardInterrupt: pass""",
}


@pytest.fixture(autouse=True)
def not_ignored():
    """Interrupts arrive here and in processes started from here, also where pytest was started with them ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("case", CASES)
def test_an_interrupt_ends_the_process(case):
    begun = time.monotonic()
    program = PROGRAM.format(body=CASES[case])
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == MESSAGE
    assert done.returncode == 130
    assert time.monotonic() - begun < 10


def test_handlers_are_as_before():
    before, hook = signal.getsignal(signal.SIGINT), sys.unraisablehook
    with interruptible():
        assert signal.getsignal(signal.SIGINT) is not before
    assert (signal.getsignal(signal.SIGINT), sys.unraisablehook) == (before, hook)
    assert not any(t.name == "jaxtrapolate-interrupt" and t.is_alive() for t in waited())


def waited():
    """The threads that are still there after a moment."""
    time.sleep(0.1)
    return threading.enumerate()


def test_outside_of_the_main_thread_nothing_is_changed():
    seen = []

    def use():
        with interruptible():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGINT)]


def test_the_program_ends_while_it_is_being_imported():
    program = "import sys; sys.argv = ['jaxtrapolate', 'scenes']\nfrom jaxtrapolate.commands import script\n"
    program += "print('ready', flush=True)\nsys.exit(script.script())"
    with subprocess.Popen([sys.executable, "-c", program], stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.3)  # JAX alone takes longer
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, MESSAGE)


def test_threads_that_are_still_at_work_say_nothing():
    """As those that write a checkpoint, which cannot go on once Python takes itself down."""
    program = """
import importlib, sys, threading
from jaxtrapolate.commands import script
def late():
    threading.main_thread().join()
    print("cannot go on", file=sys.stderr)
def main():
    threading.Thread(target=late).start()
    print("jaxtrapolate: interrupted; run again to go on", file=sys.stderr)
    return 130
importlib.import_module("jaxtrapolate.commands.main").main = main
sys.exit(script.script())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (130, MESSAGE)

"""Reading ahead: frames are read on a thread while the ones before them are worked on, in bounded memory."""

import collections
import queue
import threading
from collections.abc import Iterable, Iterator

from jaxtrapolate.files.sequence import Sequence
from jaxtrapolate.records import Frame


def prefetch(
    sequence: Sequence, numbers: Iterable[int], *, ahead: int = 2, keep: int = 6
) -> Iterator[tuple[int, Frame]]:
    """The frames `numbers` of a sequence in that order, as `(number, frame)`, read ahead on a thread.

    A number may come again, as in overlapping windows (1, 3, 5, 3, 5, 7, ...): the last `keep` different frames are
    remembered and not read again. At no time are more than `ahead + keep` frames held here, however long the
    sequence. The thread starts with the first frame asked for; it ends, and is waited for, when the iterator is
    exhausted or closed (also by a `break`, once the iterator is collected).

    Args:
        sequence: what to read; only the thread calls its `frame`.
        numbers: of the frames; taken one by one, on the thread.
        ahead: how many frames may wait to be asked for, at least 1.
        keep: how many of the last different frames are remembered, 0 for none.

    Raises:
        ValueError: options out of range.
        Exception: what reading a frame raised, at its position in the order.
    """
    if ahead < 1 or keep < 0:
        raise ValueError(f"ahead, keep: expected at least 1 and 0, got {ahead} and {keep}")
    return _prefetch(sequence, numbers, ahead, keep)


def _prefetch(sequence: Sequence, numbers: Iterable[int], ahead: int, keep: int) -> Iterator[tuple[int, Frame]]:
    results: queue.SimpleQueue[tuple[int, Frame] | BaseException | None] = queue.SimpleQueue()
    places = threading.Semaphore(ahead)
    stopped = threading.Event()
    arguments = (sequence, numbers, keep, results, places, stopped)
    thread = threading.Thread(target=_read, args=arguments, name="jaxtrapolate-prefetch", daemon=True)
    thread.start()
    try:
        while (result := results.get()) is not None:
            if isinstance(result, BaseException):
                raise result
            places.release()
            yield result
            del result
    finally:
        stopped.set()
        places.release()
        thread.join()


def _read(
    sequence: Sequence,
    numbers: Iterable[int],
    keep: int,
    results: "queue.SimpleQueue[tuple[int, Frame] | BaseException | None]",
    places: threading.Semaphore,
    stopped: threading.Event,
) -> None:
    """The thread: a place is taken before a frame is read, and given back when the frame is handed out."""
    recent: collections.OrderedDict[int, Frame] = collections.OrderedDict()
    try:
        for number in numbers:
            places.acquire()
            if stopped.is_set():
                return
            frame = recent.pop(number) if number in recent else sequence.frame(number)
            if keep:
                recent[number] = frame
                if len(recent) > keep:
                    recent.popitem(last=False)
            results.put((number, frame))
            del frame
        results.put(None)
    except BaseException as error:
        results.put(error)

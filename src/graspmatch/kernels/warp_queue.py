"""Elements of a launch handed out to the threads that share it.

On a CPU every thread runs the kernel for all elements, each from a place of its own on and around, and the first to
come to an element takes it: threads stay busy until the last one is taken, however much elements differ in what they
cost. Who takes an element makes no difference to what is written of it. A launch may have several rounds, of which each
begins when all elements of the one before are done. On CUDA every element has its threads, and every round a launch.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Queue:
    """What one CPU thread knows of a launch."""

    begin: wp.int32
    """Where it begins in every round, ..."""
    size: wp.int32
    """... of so many elements."""
    rounds: wp.int32
    thread: wp.int32
    """Its number, from one."""
    shared: wp.uint64
    """Address of what the threads tell each other: for each round how many elements are done (int32), for each element
    the thread that has taken it, or zero (a byte)."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return begin + k;
#else
    int* done = (int*)shared;
    unsigned char* owner = (unsigned char*)(done + rounds);
    auto place = [=](int k) {
        int round = k / size, i = begin + k % size;
        return round * size + (i < size ? i : i - size);
    };
    auto wait_for = [=](int round) {
        int yield_core(void) asm("sched_yield");
        for (int patience = 1000; __atomic_load_n(done + round, __ATOMIC_ACQUIRE) < size; --patience)
            if (patience < 0) yield_core();
    };
    if (k > 0 && owner[place(k - 1)] == thread) __atomic_fetch_add(done + (k - 1) / size, 1, __ATOMIC_RELEASE);
    if (k == rounds * size) {
        if (thread == 1) wait_for(rounds - 1);
        return -1;
    }
    int element = place(k);
    unsigned char none = 0;
    if (!__atomic_compare_exchange_n(owner + element, &none, thread, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED))
        return -1;
    if (k >= size) wait_for(k / size - 1);
    return element;
#endif
""")
def take_from(begin: int, size: int, rounds: int, thread: int, shared: wp.uint64, k: int) -> int: ...


@wp.func
def take(queue: Queue, k: int) -> int:
    """The k-th element that a thread comes to, those of later rounds after those of earlier ones; -1 where another
    thread has it. A CPU thread comes once more after the last one: the first thread leaves when all is done."""
    return take_from(queue.begin, queue.size, queue.rounds, queue.thread, queue.shared, k)

"""Elements of a launch handed out to the threads that share it.

On a CPU every thread runs the kernel for all elements, each from a place of its own on and around, and the first to
come to an element takes it: threads stay busy until the last one is taken, however much elements differ in what they
cost. Who takes an element makes no difference to what is written of it. On CUDA every element has its threads.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Queue:
    """What one CPU thread knows of a launch."""

    begin: wp.int32
    """Where it begins, ..."""
    size: wp.int32
    """... of so many elements."""
    taken: wp.uint64
    """Address of a byte for each of them that tells whether some thread has taken it."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return k;
#else
    int i = begin + k < size ? begin + k : begin + k - size;
    unsigned char* flags = (unsigned char*)taken;
    return __atomic_exchange_n(flags + i, 1, __ATOMIC_RELAXED) ? -1 : i;
#endif
""")
def take_from(begin: int, size: int, taken: wp.uint64, k: int) -> int: ...


@wp.func
def take(queue: Queue, k: int) -> int:
    """The k-th element that a thread comes to; -1 where another thread has it."""
    return take_from(queue.begin, queue.size, queue.taken, k)

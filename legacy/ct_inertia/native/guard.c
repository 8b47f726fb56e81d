/* Mapped files that shrink, or whose disk fails, while they are read: the pages that are gone become zeros and
   are counted, where the system would end the process with SIGBUS. The caller looks at the count and refuses
   the numbers. As in systemd (src/basic/sigbus.c). On Windows a mapped file cannot be cut. */

#define _GNU_SOURCE
#define _DARWIN_C_SOURCE
#include "stapes.h"

#ifdef _WIN32

API int64_t guarded(const void *start, int64_t bytes) { (void)start; return bytes < 0 ? -1 : 0; }
API void unguarded(int64_t slot) { (void)slot; }
API int64_t lost_pages(void) { return 0; }

#else

#include <signal.h>
#include <stdatomic.h>
#include <stdint.h>
#include <sys/mman.h>
#include <unistd.h>

#ifndef MAP_ANONYMOUS
#define MAP_ANONYMOUS MAP_ANON
#endif
#define SLOTS 256

static _Atomic uintptr_t starts[SLOTS], ends[SLOTS];
static _Atomic int64_t lost;
static uintptr_t page_mask;
static struct sigaction before;
static atomic_flag installing = ATOMIC_FLAG_INIT;
static _Atomic int installed;

static void replace_lost_pages(int number, siginfo_t *info, void *context)
{
    (void)number;
    (void)context;
    uintptr_t at = (uintptr_t)info->si_addr;
    for (int slot = 0; slot < SLOTS; slot++) {
        uintptr_t start = atomic_load(&starts[slot]), end = atomic_load(&ends[slot]);
        if (start == 0 || at < start || at >= end)
            continue;
        uintptr_t page = at & ~page_mask;
        int flags = MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED;
#ifdef MAP_NORESERVE
        flags |= MAP_NORESERVE;
#endif
        if (mmap((void *)page, end - page, PROT_READ | PROT_WRITE, flags, -1, 0) == MAP_FAILED)
            break;
        atomic_fetch_add(&lost, 1);
        return;
    }
    /* Not a guarded map: the fault is met again under the action from before. */
    sigaction(SIGBUS, &before, NULL);
}

/* Guards a map; returns its slot, or -1 when all are taken. */
API int64_t guarded(const void *start, int64_t bytes)
{
    while (!atomic_load(&installed)) {
        if (atomic_flag_test_and_set(&installing))
            continue; /* another thread is at it */
        struct sigaction action = {0};
        page_mask = (uintptr_t)sysconf(_SC_PAGESIZE) - 1;
        action.sa_sigaction = replace_lost_pages;
        action.sa_flags = SA_SIGINFO | SA_NODEFER | SA_ONSTACK;
        sigemptyset(&action.sa_mask);
        if (sigaction(SIGBUS, &action, &before) != 0) {
            atomic_flag_clear(&installing);
            return -1;
        }
        atomic_store(&installed, 1);
    }
    for (int slot = 0; slot < SLOTS; slot++) {
        uintptr_t none = 0;
        if (atomic_compare_exchange_strong(&ends[slot], &none, (uintptr_t)start + (uintptr_t)bytes)) {
            atomic_store(&starts[slot], (uintptr_t)start);
            return slot;
        }
    }
    return -1;
}

API void unguarded(int64_t slot)
{
    atomic_store(&starts[slot], 0);
    atomic_store(&ends[slot], 0);
}

/* The number of times that pages of guarded maps were gone. */
API int64_t lost_pages(void)
{
    return atomic_load(&lost);
}

#endif

/* What the kernels share. They are called through ctypes, which gives the interpreter free meanwhile; they
 * keep no state (guard.c does), write only to what they are handed, and return -1 where memory runs out. Arrays are
 * contiguous; shapes are z, y, x. Compiled with -ffp-contract=off: results do not depend on the processor. */
#ifndef STAPES_H
#define STAPES_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif

/* A version for each kind of processor, chosen as the library is loaded. Where the compiler knows of none, one. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define CLONES __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define CLONES
#endif
#if defined(__GNUC__)
#define INLINED static inline __attribute__((always_inline))
#else
#define INLINED static inline
#endif

static inline int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t most(int64_t a, int64_t b) { return a > b ? a : b; }

#endif

/* What the kernels of this room share: wide vectors, clones for the processor at hand, export.
 *
 * A vector is 8 doubles, which the compiler cuts into what the processor has. Products and sums are fused where
 * it can: results differ from processor to processor in the last digit, as those of linear algebra libraries do.
 */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=fast")
#endif
#include <stdint.h>
#include <string.h>

#define WIDE 8
#define SIZE 6
#define HALF (SIZE * (SIZE + 1) / 2)
#define INLINE static inline __attribute__((always_inline))
#define LANES for (int l = 0; l < WIDE; l++)

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define CLONES __attribute__((target_clones("default", "fma", "avx512f")))
#else
#define CLONES
#endif
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef double vec __attribute__((vector_size(8 * WIDE)));
typedef uint64_t bits __attribute__((vector_size(8 * WIDE)));
typedef double loose __attribute__((vector_size(8 * WIDE), aligned(8), may_alias));
/* a vector in memory at any address of a double */
#define AT(place) (*(loose *)(place))
#define FROM(place) (*(const loose *)(place))

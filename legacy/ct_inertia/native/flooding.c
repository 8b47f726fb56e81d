/* Watershed by flooding from markers. */
#include "stapes.h"

typedef struct {
    uint64_t key; /* height, the highest first, then the order of arrival */
    int64_t place;
} Drop;

typedef struct {
    Drop *drop;
    int64_t count, room;
} Queue;

static uint64_t key_of(float height, uint64_t from, uint32_t arrival)
{
    uint32_t bits;
    const float below = 0.0f - height; /* no negative zero */
    memcpy(&bits, &below, sizeof bits);
    bits = bits >> 31 ? ~bits : bits | 0x80000000u;
    return (bits > from ? bits : from) << 32 | arrival;
}

static int push(Queue *q, uint64_t key, int64_t place)
{
    if (q->count == q->room) {
        const int64_t room = q->room + q->room / 4 + (1 << 16);
        Drop *more = realloc(q->drop, (size_t)room * sizeof *more);
        if (!more)
            return -1;
        q->drop = more;
        q->room = room;
    }
    int64_t at = q->count++;
    while (at > 0 && q->drop[(at - 1) / 2].key > key) {
        q->drop[at] = q->drop[(at - 1) / 2];
        at = (at - 1) / 2;
    }
    q->drop[at] = (Drop){key, place};
    return 0;
}

static Drop pop(Queue *q)
{
    const Drop first = q->drop[0];
    const Drop last = q->drop[--q->count];
    int64_t at = 0;
    for (int64_t next = 1; next < q->count; next = 2 * at + 1) {
        if (next + 1 < q->count && q->drop[next + 1].key < q->drop[next].key)
            next++;
        if (q->drop[next].key >= last.key)
            break;
        q->drop[at] = q->drop[next];
        at = next;
    }
    q->drop[at] = last;
    return first;
}

static int around(int64_t place, const int64_t *shape, int64_t *beside)
{
    const int64_t layer = shape[1] * shape[2], z = place / layer, y = place / shape[2] % shape[1], x = place % shape[2];
    int count = 0;
    if (z > 0)
        beside[count++] = place - layer;
    if (y > 0)
        beside[count++] = place - shape[2];
    if (x > 0)
        beside[count++] = place - 1;
    if (x + 1 < shape[2])
        beside[count++] = place + 1;
    if (y + 1 < shape[1])
        beside[count++] = place + shape[2];
    if (z + 1 < shape[0])
        beside[count++] = place + layer;
    return count;
}

/* Give every voxel of a mask to the marker whose flood reaches it first from the high side (Meyer 1994,
 * doi:10.1016/0165-1684(94)90060-4): the highest voxel beside the flooded ones follows, of equal ones the first seen,
 * and what lies above the flood's level behind it counts as at that level.
 * All markers wait in the queue from the beginning, as in scikit-image, so that equal heights go the same way.
 * `labels` holds the markers, 0 elsewhere, and then the result. */
API int64_t flooded(const float *height, const uint8_t *mask, const int64_t *shape, int32_t *labels)
{
    const int64_t total = shape[0] * shape[1] * shape[2];
    int64_t beside[6];
    uint32_t arrival = 0;
    Queue queue = {NULL, 0, 0};
    for (int64_t i = 0; i < total; i++)
        if (!mask[i] || labels[i] < 0)
            labels[i] = 0;
    for (int64_t i = 0; i < total; i++)
        if (labels[i] && push(&queue, key_of(height[i], 0, 0), i))
            goto full;
    while (queue.count) {
        const Drop from = pop(&queue);
        const int64_t place = from.place;
        const int count = around(place, shape, beside);
        for (int k = 0; k < count; k++)
            if (mask[beside[k]] && !labels[beside[k]]) {
                labels[beside[k]] = labels[place];
                if (push(&queue, key_of(height[beside[k]], from.key >> 32, ++arrival), beside[k]))
                    goto full;
            }
    }
    free(queue.drop);
    return 0;
full:
    free(queue.drop);
    return -1;
}

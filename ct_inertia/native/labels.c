/* Labels: voxels above a grey value in the cells of a coarser grid, and their runs packed as gzip. */
#include "stapes.h"

/* Write `number` where a voxel lies in a cell and above a grey value: `above` for all cells, or that of each cell in
 * `of_cell`, rounded down and kept within `lowest` .. `highest`. Everything is x, y, z here: `low` is the place of the
 * part's first voxel, `size` its extent, `first` the first voxel of the first cell, `step` the voxels of a cell.
 * `stride` is the distance of rows and layers in the scan. */
#define MARKED(NAME, T)                                                                                              \
    API void NAME(const T *part, const int64_t *stride, const int64_t *low, const int64_t *size, const uint8_t *cells, \
                  const int64_t *cell_shape, const int64_t *first, const int64_t *step, double above,                 \
                  const float *of_cell, double lowest, double highest, int64_t number, uint8_t *labels)               \
    {                                                                                                                \
        for (int64_t z = 0; z < size[2]; z++) {                                                                      \
            const int64_t dz = low[2] + z - first[2], cz = dz / step[2];                                             \
            if (dz < 0 || cz >= cell_shape[0])                                                                       \
                continue;                                                                                            \
            for (int64_t y = 0; y < size[1]; y++) {                                                                  \
                const int64_t dy = low[1] + y - first[1], cy = dy / step[1];                                         \
                if (dy < 0 || cy >= cell_shape[1])                                                                   \
                    continue;                                                                                        \
                const uint8_t *cell = cells + (cz * cell_shape[1] + cy) * cell_shape[2];                             \
                const T *from = part + z * stride[1] + y * stride[0];                                                \
                uint8_t *to = labels + (z * size[1] + y) * size[0];                                                  \
                for (int64_t c = 0; c < cell_shape[2];) {                                                            \
                    if (!cell[c]) {                                                                                  \
                        const uint8_t *next = memchr(cell + c, 1, (size_t)(cell_shape[2] - c));                      \
                        if (!next)                                                                                   \
                            break;                                                                                   \
                        c = next - cell;                                                                             \
                    }                                                                                                \
                    int64_t end = c + 1;                                                                             \
                    while (!of_cell && end < cell_shape[2] && cell[end])                                             \
                        end++;                                                                                       \
                    double limit = floor(of_cell ? (double)of_cell[cell - cells + c] : above);                       \
                    limit = limit < lowest ? lowest : limit > highest ? highest : limit;                             \
                    const T over = (T)limit;                                                                         \
                    const int64_t x0 = most(first[0] + c * step[0] - low[0], 0);                                     \
                    const int64_t x1 = least(first[0] + end * step[0] - low[0], size[0]);                            \
                    for (int64_t x = x0; x < x1; x++)                                                                \
                        to[x] = from[x] > over ? (uint8_t)number : to[x];                                            \
                    c = end;                                                                                         \
                }                                                                                                    \
            }                                                                                                        \
        }                                                                                                            \
    }

MARKED(marked_uint8, uint8_t)
MARKED(marked_int8, int8_t)
MARKED(marked_uint16, uint16_t)
MARKED(marked_int16, int16_t)

/* Deflate (RFC 1951) of runs of the values 0 to 3: one block with a code of its own, in which the longest match costs
 * one bit, a value four, and every other length six or seven; all matches are one byte back. */
typedef struct {
    uint64_t bits;
    int64_t filled, run, total;
    uint32_t check;
    int32_t value;
} Packer;

static uint32_t turned(uint32_t code, int length)
{
    uint32_t out = 0;
    for (int k = 0; k < length; k++)
        out |= (code >> k & 1) << (length - 1 - k);
    return out;
}

static void put(Packer *p, uint64_t code, int length, uint8_t **out)
{
    p->bits |= code << p->filled;
    p->filled += length;
    while (p->filled >= 8) {
        *(*out)++ = (uint8_t)p->bits;
        p->bits >>= 8;
        p->filled -= 8;
    }
}

/* Lengths of the codes of the symbols 0 to 285, and the codes, first bit lowest. */
static void codes(uint8_t *length, uint32_t *code)
{
    uint32_t next = 0;
    memset(length, 0, 286);
    for (int k = 0; k < 4; k++)
        length[k] = 4;
    for (int k = 256; k < 285; k++)
        length[k] = k > 256 && k < 260 ? 6 : 7;
    length[285] = 1;
    for (int bits = 1; bits <= 7; bits++, next <<= 1)
        for (int k = 0; k < 286; k++)
            if (length[k] == bits)
                code[k] = turned(next++, bits);
}

static void put_run(Packer *p, const uint8_t *length, const uint32_t *code, uint8_t **out)
{
    static const int base[29] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
    static const int extra[29] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};
    int64_t rest = p->run;
    if (rest > 0) {
        put(p, code[p->value], length[p->value], out);
        rest--;
    }
    while (rest >= 258) {
        put(p, code[285], length[285] + 1, out); /* the one distance is the bit 0 */
        rest -= 258;
    }
    if (rest >= 3) {
        int k = 27;
        while (base[k] > rest)
            k--;
        put(p, code[257 + k], length[257 + k], out);
        put(p, (uint64_t)(rest - base[k]), extra[k] + 1, out);
        rest = 0;
    }
    for (; rest > 0; rest--)
        put(p, code[p->value], length[p->value], out);
    p->run = 0;
}

/* CRC-32 with sixteen tables (Kounavis and Berry 2005, doi:10.1109/ISCC.2005.18). */
static uint32_t checked(uint32_t check, const uint8_t *data, int64_t count)
{
    uint32_t table[16][256];
    for (uint32_t k = 0; k < 256; k++) {
        uint32_t c = k;
        for (int bit = 0; bit < 8; bit++)
            c = c & 1 ? c >> 1 ^ 0xEDB88320u : c >> 1;
        table[0][k] = c;
    }
    for (int t = 1; t < 16; t++)
        for (int k = 0; k < 256; k++)
            table[t][k] = table[t - 1][k] >> 8 ^ table[0][table[t - 1][k] & 255];
    check = ~check;
    for (; count >= 16; count -= 16, data += 16) {
        uint32_t first = check ^ ((uint32_t)data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24);
        check = table[15][first & 255] ^ table[14][first >> 8 & 255] ^ table[13][first >> 16 & 255] ^ table[12][first >> 24];
        for (int k = 4; k < 16; k++)
            check ^= table[15 - k][data[k]];
    }
    for (; count > 0; count--, data++)
        check = check >> 8 ^ table[0][(check ^ *data) & 255];
    return ~check;
}

/* Begin, go on with or end a gzip member (RFC 1952) of labels 0 to 3; `memory` (64 bytes) holds what is under way.
 * `stage` is 0 for the first piece, 1 for others, 2 for the end without data. `out` has room for count + 1024 bytes.
 * Returns how many were written, or -1 for a value above 3. */
API int64_t packed(uint8_t *memory, int64_t stage, const uint8_t *data, int64_t count, uint8_t *out)
{
    uint8_t length[286], *at = out;
    uint32_t code[286];
    Packer p;
    codes(length, code);
    if (stage == 0) {
        static const uint8_t head[10] = {0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255};
        /* lengths of the codes that tell the lengths: 0 in one bit, 7 in two, 4 in three, 1 and 6 in four */
        static const uint8_t order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
        static const uint8_t told[8] = {1, 4, 0, 0, 3, 0, 4, 2};
        static const uint8_t short_code[8] = {0, 14, 0, 0, 6, 0, 15, 2};
        memset(&p, 0, sizeof p);
        p.value = -1;
        memcpy(at, head, sizeof head);
        at += sizeof head;
        put(&p, 1 | 2 << 1, 3, &at); /* the last block, with codes of its own */
        put(&p, 29, 5, &at);         /* 286 symbols */
        put(&p, 0, 5, &at);          /* one distance */
        put(&p, 15, 4, &at);
        for (int k = 0; k < 19; k++)
            put(&p, order[k] < 8 ? told[order[k]] : 0, 3, &at);
        for (int k = 0; k < 287; k++) {
            const int bits = k < 286 ? length[k] : 1;
            put(&p, turned(short_code[bits], told[bits]), told[bits], &at);
        }
    } else
        memcpy(&p, memory, sizeof p);
    if (stage == 2) {
        put(&p, code[256], length[256], &at);
        put(&p, 0, 7, &at);
        for (int k = 0; k < 4; k++)
            *at++ = (uint8_t)(p.check >> 8 * k);
        for (int k = 0; k < 4; k++)
            *at++ = (uint8_t)(p.total >> 8 * k);
        return at - out;
    }
    for (int64_t i = 0; i < count;) {
        const uint8_t value = data[i];
        const uint64_t same = 0x0101010101010101u * value;
        const int64_t start = i;
        if (value > 3)
            return -1;
        if (value != p.value) {
            put_run(&p, length, code, &at);
            p.value = value;
        }
        for (uint64_t word; i + 8 <= count; i += 8) {
            memcpy(&word, data + i, 8);
            if (word != same)
                break;
        }
        while (i < count && data[i] == value)
            i++;
        p.run += i - start;
    }
    put_run(&p, length, code, &at); /* a run never waits for the next piece: there is room for this one's alone */
    p.value = -1;
    p.check = checked(p.check, data, count);
    p.total += count;
    memcpy(memory, &p, sizeof p);
    return at - out;
}

// The package's CPU engine once more in C++ with GCC's vector types: the limit that a compiler sets to the algorithm.
// Steps, names and layouts are those of src/hingesplat/render/_project.py, _tiles.py and _blend.py. One thread; the
// features are rgb and depth; a scene needs at least L Gaussians.
#include <immintrin.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#ifdef __AVX512F__
constexpr int L = 16;
#else
constexpr int L = 8;
#endif
typedef float V __attribute__((vector_size(4 * L)));
typedef float Loose __attribute__((vector_size(4 * L), aligned(4), may_alias));
typedef int32_t M __attribute__((vector_size(4 * L)));

constexpr int F = 4, TILE = 32, PITCH = TILE + L, PLANE = (TILE + 1) * PITCH, CHECK_EVERY = 32, DIGIT = 11;
constexpr int RX = 0, RY = 1, RA = 2, RB = 3, RC = 4, RLOG = 5, REX = 6, REY = 7, RDEPTH = 8, RF = 9, RECORD = 16;
constexpr int SUMS = (6 + F + L - 1) / L * L;
constexpr int FX = 12, FY = 13, CX = 14, CY = 15, NEAR = 16, XMIN = 17, XMAX = 18, YMIN = 19, YMAX = 20, W = 21, H = 22;
constexpr float ALPHA_MAX = 0.999f, ALPHA_MIN = 1 / 255.f, LOG2_ALPHA_MIN = -7.994353436858858f, BLUR = 0.3f;
constexpr float TINY = 1e-6f, LOG2_E = 1.4426950408889634f, LN_2 = 0.6931471805599453f;

#define INLINE static inline __attribute__((always_inline))
INLINE V splat(float x) { return x - V{}; }
INLINE V load(const float *p) { return *(const Loose *)p; }
INLINE void store(float *p, V x) { *(Loose *)p = x; }
INLINE V least(V x, V y) { return x < y ? x : y; }
INLINE V most(V x, V y) { return x > y ? x : y; }
INLINE V iota() {
    V r;
    for (int l = 0; l < L; l++) r[l] = l;
    return r;
}
INLINE V gather(const float *p, int64_t stride) {
    V r;
    for (int l = 0; l < L; l++) r[l] = p[l * stride];
    return r;
}
template <class T> INLINE void scatter(T *p, int64_t stride, V x) {
    for (int l = 0; l < L; l++) p[l * stride] = (T)x[l];
}
#ifdef __AVX512F__
INLINE bool any_above(V x, V y) { return _mm512_cmp_ps_mask(x, y, _CMP_GT_OQ); }
INLINE V root(V x) { return _mm512_sqrt_ps(x); }
INLINE V down(V x) { return _mm512_floor_ps(x); }
INLINE V up(V x) { return _mm512_ceil_ps(x); }
INLINE float total(V x) { return _mm512_reduce_add_ps(x); }
#else
INLINE bool any_above(V x, V y) { return _mm256_movemask_ps(_mm256_cmp_ps(x, y, _CMP_GT_OQ)); }
INLINE V root(V x) { return _mm256_sqrt_ps(x); }
INLINE V down(V x) { return _mm256_floor_ps(x); }
INLINE V up(V x) { return _mm256_ceil_ps(x); }
INLINE float total(V x) {
    float s = 0;
    for (int l = 0; l < L; l++) s += x[l];
    return s;
}
#endif

// The sums of the lanes of 6 + F vectors, and zeros, side by side: a tree of shuffles and additions.
template <int... K> INLINE V merged(V x, V y) { return __builtin_shuffle(x, y, M{K...}); }
INLINE void store_sums(const V *x, int count, float *p) {
#ifdef __AVX512F__
    // Rows of a 16 × 16 transpose, added at every level: after four levels lane j holds the sum of x[j].
    V a[16], b[8], c[4], d[2];
    for (int j = 0; j < 16; j++) a[j] = j < count ? x[j] : V{};
    for (int j = 0; j < 8; j++)
        b[j] = merged<0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30>(a[2 * j], a[2 * j + 1]) +
               merged<1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31>(a[2 * j], a[2 * j + 1]);
    for (int j = 0; j < 4; j++)
        c[j] = merged<0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29>(b[2 * j], b[2 * j + 1]) +
               merged<2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31>(b[2 * j], b[2 * j + 1]);
    for (int j = 0; j < 2; j++)
        d[j] = merged<0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27>(c[2 * j], c[2 * j + 1]) +
               merged<4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31>(c[2 * j], c[2 * j + 1]);
    store(p, merged<0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23>(d[0], d[1]) +
                 merged<8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31>(d[0], d[1]));
#else
    for (int j = 0; j < SUMS; j++) p[j] = j < count ? total(x[j]) : 0;
#endif
}

INLINE V exp2_of(V e) {  // -8 ≤ e ≤ 0
    V u = e * 0.125f;
    V p = ((((u * 0.000938788304101934f + 0.009188611646813588f) * u + 0.05527972250486135f) * u +
            0.24017218921989097f) * u + 0.6931422525893657f) * u + 0.9999999250634352f;
    p = p * p;
    p = p * p;
    return p * p;
}
INLINE V log2_of(V x) {
    M bits = (M)x;
    V exponent = __builtin_convertvector((bits >> 23) - 127, V);
    V m = (V)((bits & 0x7fffff) | (127 << 23)) - 1.0f;
    V p = (((((m * 0.020233915361827077f - 0.09487798136284191f) * m + 0.2136625904983307f) * m -
             0.3378349451317032f) * m + 0.47722417313055904f) * m - 0.7210954782223373f) * m + 1.4426907807067442f;
    return m * p + exponent;
}

struct Context {
    int64_t n = 0, visible = 0;
    int width = 0, height = 0, columns = 0, tiles = 0;
    float floor = 0, view[23];
    std::vector<float> record, image, partial;
    std::vector<int32_t> boxes, segments, order, scratch, items, slots, shapes;
    std::vector<int64_t> offsets, starts, stops, cursor;
};

struct Shape { V w, x, y, z, shrink, r[9], s[3]; };
INLINE Shape shape_of(int64_t i, const float *quats, const float *scales) {
    V w = gather(quats + 4 * i, 4), x = gather(quats + 4 * i + 1, 4), y = gather(quats + 4 * i + 2, 4),
      z = gather(quats + 4 * i + 3, 4);
    V shrink = 1.0f / root(w * w + x * x + y * y + z * z);
    w *= shrink, x *= shrink, y *= shrink, z *= shrink;
    return {w, x, y, z, shrink,
            {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
             1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
             1 - 2 * (x * x + y * y)},
            {gather(scales + 3 * i, 3), gather(scales + 3 * i + 1, 3), gather(scales + 3 * i + 2, 3)}};
}
struct Flat { V x, y, z, inverse, u, v, h[6], g[6], b[6], c00, c01, c11, det; };
INLINE Flat flat_of(int64_t i, const float *means, const float *k, const Shape &q) {
    Flat f;
    V x = gather(means + 3 * i, 3), y = gather(means + 3 * i + 1, 3), z = gather(means + 3 * i + 2, 3);
    f.x = x * k[0] + y * k[1] + z * k[2] + k[9];
    f.y = x * k[3] + y * k[4] + z * k[5] + k[10];
    f.z = x * k[6] + y * k[7] + z * k[8] + k[11];
    f.inverse = 1.0f / most(f.z, splat(TINY));
    f.u = f.x * f.inverse, f.v = f.y * f.inverse;
    V u = least(most(f.u, splat(k[XMIN])), splat(k[XMAX])), v = least(most(f.v, splat(k[YMIN])), splat(k[YMAX]));
    V jx = f.inverse * k[FX], jy = f.inverse * k[FY];
    for (int c = 0; c < 3; c++) {
        f.h[c] = k[c] - u * k[6 + c], f.h[3 + c] = k[3 + c] - v * k[6 + c];
        f.g[c] = jx * f.h[c], f.g[3 + c] = jy * f.h[3 + c];
    }
    for (int row = 0; row < 2; row++)
        for (int c = 0; c < 3; c++)
            f.b[3 * row + c] =
                (f.g[3 * row] * q.r[c] + f.g[3 * row + 1] * q.r[3 + c] + f.g[3 * row + 2] * q.r[6 + c]) * q.s[c];
    V *b = f.b;
    V t00 = b[0] * b[0] + b[1] * b[1] + b[2] * b[2], t11 = b[3] * b[3] + b[4] * b[4] + b[5] * b[5];
    V m01 = b[0] * b[4] - b[1] * b[3], m02 = b[0] * b[5] - b[2] * b[3], m12 = b[1] * b[5] - b[2] * b[4];
    f.det = m01 * m01 + m02 * m02 + m12 * m12 + BLUR * (t00 + t11 + BLUR);
    f.c00 = t00 + BLUR, f.c01 = b[0] * b[3] + b[1] * b[4] + b[2] * b[5], f.c11 = t11 + BLUR;
    return f;
}

static void project(Context &c, const float *means, const float *quats, const float *scales, const float *opacities,
                    const float *colors) {
    const float *k = c.view;
    for (int64_t start = 0; start < c.n; start += L) {
        int64_t i = std::min(start, c.n - L);
        Shape q = shape_of(i, quats, scales);
        Flat f = flat_of(i, means, k, q);
        V o = load(opacities + i), mx = f.u * k[FX] + k[CX], my = f.v * k[FY] + k[CY], inverse = 1.0f / f.det;
        V log_o = log2_of(most(o, splat(TINY)));
        V spread = most(log_o - LOG2_ALPHA_MIN, V{}) * (2 * LN_2);
        V ex = root(spread * f.c00), ey = root(spread * f.c11);
        V x0 = most(up(mx - ex - 0.5f), V{}), x1 = least(down(mx + ex - 0.5f), splat(k[W] - 1));
        V y0 = most(up(my - ey - 0.5f), V{}), y1 = least(down(my + ey - 0.5f), splat(k[H] - 1));
        M visible = (f.z > k[NEAR]) & (o > ALPHA_MIN) & (f.det > 1e-12f) & (x1 + 0.5f > x0) & (y1 + 0.5f > y0);
        int32_t *box = c.boxes.data() + 4 * i;
        scatter(box, 4, visible ? x0 : V{}), scatter(box + 1, 4, visible ? x1 : splat(-1));
        scatter(box + 2, 4, visible ? y0 : V{}), scatter(box + 3, 4, visible ? y1 : splat(-1));
        float *r = c.record.data() + i * RECORD;
        scatter(r + RX, RECORD, mx), scatter(r + RY, RECORD, my);
        scatter(r + RA, RECORD, f.c11 * inverse * (-0.5f * LOG2_E));
        scatter(r + RB, RECORD, f.c01 * inverse * LOG2_E);
        scatter(r + RC, RECORD, f.c00 * inverse * (-0.5f * LOG2_E));
        scatter(r + RLOG, RECORD, log_o), scatter(r + REX, RECORD, ex), scatter(r + REY, RECORD, ey);
        scatter(r + RDEPTH, RECORD, f.z), scatter(r + RF + 3, RECORD, f.z);
        for (int l = 0; l < L; l++)
            for (int j = 0; j < 3; j++) r[l * RECORD + RF + j] = colors[3 * (i + l) + j];
    }
}

static int segments_in_column(int x0, int x1, int column) {
    return (std::min(x1, column * TILE + TILE - 1) - std::max(x0, column * TILE)) / L + 1;
}
static int64_t key_of(const Context &c, int64_t i) {
    int32_t bits;
    memcpy(&bits, &c.record[i * RECORD + RDEPTH], 4);
    return bits;
}
static void sort_and_offset(Context &c) {
    std::fill(c.starts.begin(), c.starts.end(), 0);
    int64_t total = 0, visible = 0, low = 1LL << 31, high = 0;
    for (int64_t i = 0; i < c.n; i++) {
        const int32_t *box = &c.boxes[4 * i];
        int count = 0;
        if (box[1] >= box[0]) {
            int row0 = box[2] / TILE, row1 = box[3] / TILE;
            for (int column = box[0] / TILE; column <= box[1] / TILE; column++) {
                int s = segments_in_column(box[0], box[1], column);
                count += s;
                for (int row = row0; row <= row1; row++) c.starts[row * c.columns + column + 1] += s;
            }
            count *= row1 - row0 + 1;
        }
        c.offsets[i] = total;
        if (count) {
            total += count;
            int64_t key = key_of(c, i);
            low = std::min(low, key), high = std::max(high, key);
            c.order[visible++] = i;
        }
    }
    c.offsets[c.n] = total;
    for (int tile = 0; tile < c.tiles; tile++) c.starts[tile + 1] += c.starts[tile];
    int64_t counts[1 << DIGIT];
    for (int shift = 0; visible && (high - low) >> shift > 0; shift += DIGIT) {
        memset(counts, 0, sizeof counts);
        for (int64_t j = 0; j < visible; j++) counts[(key_of(c, c.order[j]) - low) >> shift & ((1 << DIGIT) - 1)]++;
        int64_t position = 0;
        for (auto &count : counts) {
            int64_t here = count;
            count = position, position += here;
        }
        for (int64_t j = 0; j < visible; j++)
            c.scratch[counts[(key_of(c, c.order[j]) - low) >> shift & ((1 << DIGIT) - 1)]++] = c.order[j];
        std::swap(c.order, c.scratch);
    }
    c.visible = visible;
    if ((int64_t)c.items.size() < total) c.items.resize(total), c.slots.resize(total), c.shapes.resize(total);
}

static void fill_lists(Context &c) {
    c.cursor.assign(c.starts.begin(), c.starts.end() - 1);
    for (int64_t j = 0; j < c.visible; j++) {
        int32_t g = c.order[j];
        const int32_t *box = &c.boxes[4 * g];
        int x0 = box[0], x1 = box[1], y0 = box[2], y1 = box[3];
        const float *r = &c.record[(int64_t)g * RECORD];
        int64_t slot0 = c.offsets[g];
        if (x0 / TILE == x1 / TILE && y0 / TILE == y1 / TILE && x1 - x0 < L) {
            int64_t p = c.cursor[y0 / TILE * c.columns + x0 / TILE]++;
            c.items[p] = g, c.slots[p] = slot0;
            c.shapes[p] = x0 % TILE | (y0 % TILE) << 8 | (y1 - y0 + 1) << 16;
            continue;
        }
        float a = -r[RA], b = -0.5f * r[RB], cc = -r[RC], spread = r[RLOG] - LOG2_ALPHA_MIN;
        float reach_x = std::max(r[REX], TINY), topmost = -b * r[REY] / a;
        int first = y0 / TILE, last = y1 / TILE, per_row = 0, done = 0;
        for (int column = x0 / TILE; column <= x1 / TILE; column++) per_row += segments_in_column(x0, x1, column);
        for (int column = x0 / TILE; column <= x1 / TILE; column++) {
            int end = std::min(x1, column * TILE + TILE - 1);
            for (int x = std::max(x0, column * TILE); x <= end; x += L, done++) {
                float left = x + 0.5f - r[RX], right = std::min(x + L - 1, end) + 0.5f - r[RX];
                auto edge = [&](float s, float sign) {
                    s = std::min(std::max(s, left), right);
                    float q = s / reach_x;
                    return (-b * s + sign * std::sqrt(std::max(cc * spread * (1 - q * q), 0.0f))) / cc;
                };
                int low = std::max(y0, (int)std::ceil(r[RY] + edge(-topmost, -1) - 0.5f));
                int high = std::min(y1, (int)std::floor(r[RY] + edge(topmost, 1) - 0.5f));
                for (int row = first; row <= last; row++) {
                    int start = std::max(low, row * TILE);
                    int rows = std::max(std::min(high, row * TILE + TILE - 1) - start + 1, 0);
                    if (rows == 0) start = row * TILE;
                    int64_t p = c.cursor[row * c.columns + column]++;
                    c.items[p] = g, c.slots[p] = slot0 + (row - first) * per_row + done;
                    c.shapes[p] = (x - column * TILE) | (start - row * TILE) << 8 | rows << 16;
                }
            }
        }
    }
}

static int64_t blend_tile(Context &c, int tile, int x0, int y0, int x1, int y1, float *buffer) {
    for (int q = 0; q < (F + 1) * PLANE; q += L) store(buffer + q, V{});
    for (int r = 0; r <= y1 - y0; r++) std::fill(buffer + r * PITCH, buffer + r * PITCH + x1 - x0 + 1, 1.0f);
    V floor = splat(c.floor);
    for (int64_t entry = c.starts[tile]; entry < c.starts[tile + 1]; entry++) {
        if ((entry - c.starts[tile]) % CHECK_EVERY == CHECK_EVERY - 1) {
            V clearest = {};
            for (int q = 0; q < TILE * PITCH; q += L) clearest = most(clearest, load(buffer + q));
            if (!any_above(clearest, floor)) return entry;
        }
        const float *o = &c.record[(int64_t)c.items[entry] * RECORD];
        int shape = c.shapes[entry], column = shape & 255, row = shape >> 8 & 255, rows = shape >> 16;
        V dx = iota() + (x0 + column + 0.5f - o[RX]), constant = dx * o[RA] * dx + o[RLOG], linear = dx * o[RB];
        V f[F];
        for (int j = 0; j < F; j++) f[j] = splat(o[RF + j]);
        float dy = y0 + row + 0.5f - o[RY];
        float *p = buffer + row * PITCH + column;
        for (float *end = p + rows * PITCH; p < end; p += 2 * PITCH, dy += 2) {
            V t0 = load(p), t1 = load(p + PITCH);
            if (!any_above(most(t0, t1), floor)) continue;
            V e0 = (dy * o[RC] + linear) * dy + constant, e1 = ((dy + 1) * o[RC] + linear) * (dy + 1) + constant;
            V a0 = (e0 > LOG2_ALPHA_MIN) & (t0 > floor) ? least(exp2_of(e0), splat(ALPHA_MAX)) : V{};
            V a1 = (e1 > LOG2_ALPHA_MIN) & (t1 > floor) ? least(exp2_of(e1), splat(ALPHA_MAX)) : V{};
            V w0 = a0 * t0, w1 = a1 * t1;
            store(p, t0 - w0), store(p + PITCH, t1 - w1);
            V n0[F], n1[F];
            for (int j = 0; j < F; j++) n0[j] = load(p + (j + 1) * PLANE) + w0 * f[j];
            for (int j = 0; j < F; j++) n1[j] = load(p + PITCH + (j + 1) * PLANE) + w1 * f[j];
            for (int j = 0; j < F; j++) store(p + (j + 1) * PLANE, n0[j]), store(p + PITCH + (j + 1) * PLANE, n1[j]);
        }
    }
    return c.starts[tile + 1];
}

static void unblend_tile(Context &c, int tile, int x0, int y0, int x1, int y1, const float *g_image, float *buffer) {
    int64_t area = (int64_t)c.width * c.height;
    for (int q = 0; q < (F + 3) * PLANE; q += L) store(buffer + q, V{});
    for (int r = 0; r <= y1 - y0; r++)
        for (int x = 0; x <= x1 - x0; x++) {
            int64_t p = (int64_t)(y0 + r) * c.width + x0 + x;
            float *b = buffer + r * PITCH + x, rest = 0;
            for (int j = 0; j <= F; j++) rest += g_image[j * area + p] * c.image[j * area + p];
            b[0] = 1, b[PLANE] = rest, b[2 * PLANE] = g_image[F * area + p];
            for (int j = 0; j < F; j++) b[(3 + j) * PLANE] = g_image[j * area + p];
        }
    V floor = splat(c.floor);
    for (int64_t entry = c.starts[tile]; entry < c.stops[tile]; entry++) {
        const float *o = &c.record[(int64_t)c.items[entry] * RECORD];
        int shape = c.shapes[entry], column = shape & 255, row = shape >> 8 & 255, rows = shape >> 16;
        V dx = iota() + (x0 + column + 0.5f - o[RX]), constant = dx * o[RA] * dx + o[RLOG], linear = dx * o[RB];
        V f[F], sums[6 + F] = {}, s0 = {}, s1 = {}, s2 = {}, g[F] = {};
        for (int j = 0; j < F; j++) f[j] = splat(o[RF + j]);
        float dy = y0 + row + 0.5f - o[RY];
        float *p = buffer + row * PITCH + column;
        for (float *end = p + rows * PITCH; p < end;) {
            if (!any_above(most(load(p), load(p + PITCH)), floor)) {
                p += 2 * PITCH, dy += 2;
                continue;
            }
            for (int twice = 0; twice < 2; twice++, p += PITCH, dy += 1) {
                V t = load(p), e = (dy * o[RC] + linear) * dy + constant, raw = exp2_of(e);
                V alpha = (e > LOG2_ALPHA_MIN) & (t > floor) ? least(raw, splat(ALPHA_MAX)) : V{};
                V weight = alpha * t, dot = load(p + 2 * PLANE);
                for (int j = 0; j < F; j++) dot += f[j] * load(p + (3 + j) * PLANE);
                V own = weight * dot, rest = load(p + PLANE) - own;
                store(p, t - weight), store(p + PLANE, rest);
                V v = raw < ALPHA_MAX ? own - alpha * rest / (1 - alpha) : V{};
                for (int j = 0; j < F; j++) g[j] += weight * load(p + (3 + j) * PLANE);
                s0 += v, s1 += v * dy, s2 += v * (dy * dy);
            }
        }
        sums[0] = s0, sums[1] = s0 * dx, sums[2] = sums[1] * dx, sums[3] = s1, sums[4] = s1 * dx, sums[5] = s2;
        for (int j = 0; j < F; j++) sums[6 + j] = g[j];
        store_sums(sums, 6 + F, &c.partial[(int64_t)c.slots[entry] * SUMS]);
    }
    for (int64_t entry = c.stops[tile]; entry < c.starts[tile + 1]; entry++)
        memset(&c.partial[(int64_t)c.slots[entry] * SUMS], 0, SUMS * sizeof(float));
}

static void unproject(Context &c, const float *means, const float *quats, const float *scales, const float *opacities,
                      float *g_means, float *g_quats, float *g_scales, float *g_opacities, float *g_colors) {
    const float *k = c.view;
    float sums[L * SUMS];
    for (int64_t start = 0; start < c.n; start += L) {
        int64_t i = std::min(start, c.n - L);
        for (int l = 0; l < L; l++)
            for (int q = 0; q < SUMS; q += L) {
                V total = {};
                for (int64_t p = c.offsets[i + l]; p < c.offsets[i + l + 1]; p++)
                    total += load(&c.partial[p * SUMS + q]);
                store(sums + l * SUMS + q, total);
            }
        Shape q = shape_of(i, quats, scales);
        Flat f = flat_of(i, means, k, q);
        auto sum = [&](int j) { return gather(sums + j, SUMS); };
        V inverse = 1.0f / f.det, pa = f.c11 * inverse, pb = -f.c01 * inverse, pc = f.c00 * inverse;
        V sx = sum(1), sxx = sum(2), sy = sum(3), sxy = sum(4), syy = sum(5);
        store(g_opacities + i, sum(0) / load(opacities + i));
        for (int l = 0; l < L; l++)
            for (int j = 0; j < 3; j++) g_colors[3 * (i + l) + j] = sums[l * SUMS + 6 + j];
        V d_mx = pa * sx + pb * sy, d_my = pb * sx + pc * sy;
        V t00 = pa * sxx + pb * sxy, t01 = pa * sxy + pb * syy, t10 = pb * sxx + pc * sxy, t11 = pb * sxy + pc * syy;
        V e00 = t00 * pa + t01 * pb, e01 = t00 * pb + t01 * pc, e11 = t10 * pb + t11 * pc;
        V d[6], m[9], key[6];
        for (int j = 0; j < 3; j++) {
            d[j] = e00 * f.b[j] + e01 * f.b[3 + j], d[3 + j] = e01 * f.b[j] + e11 * f.b[3 + j];
            for (int row = 0; row < 3; row++) m[3 * row + j] = f.g[row] * d[j] + f.g[3 + row] * d[3 + j];
            scatter(g_scales + 3 * i + j, 3, m[j] * q.r[j] + m[3 + j] * q.r[3 + j] + m[6 + j] * q.r[6 + j]);
        }
        for (int row = 0; row < 3; row++)
            for (int j = 0; j < 3; j++) m[3 * row + j] *= q.s[j];
        V dw = 2 * (q.x * (m[7] - m[5]) + q.y * (m[2] - m[6]) + q.z * (m[3] - m[1]));
        V dx = 2 * (q.y * (m[3] + m[1]) - 2 * q.x * (m[4] + m[8]) + q.z * (m[6] + m[2]) + q.w * (m[7] - m[5]));
        V dy = 2 * (q.x * (m[3] + m[1]) - 2 * q.y * (m[0] + m[8]) + q.z * (m[7] + m[5]) + q.w * (m[2] - m[6]));
        V dz = 2 * (q.x * (m[6] + m[2]) + q.y * (m[7] + m[5]) - 2 * q.z * (m[0] + m[4]) + q.w * (m[3] - m[1]));
        V along = dw * q.w + dx * q.x + dy * q.y + dz * q.z;
        M seen;
        for (int l = 0; l < L; l++) seen[l] = c.offsets[i + l] < c.offsets[i + l + 1] ? -1 : 0;
        auto give = [&](float *p, int stride, V x) { scatter(p, stride, seen ? x : V{}); };
        give(g_quats + 4 * i, 4, (dw - along * q.w) * q.shrink), give(g_quats + 4 * i + 1, 4, (dx - along * q.x) * q.shrink);
        give(g_quats + 4 * i + 2, 4, (dy - along * q.y) * q.shrink), give(g_quats + 4 * i + 3, 4, (dz - along * q.z) * q.shrink);
        for (int row = 0; row < 2; row++)
            for (int j = 0; j < 3; j++)
                key[3 * row + j] = d[3 * row] * q.r[3 * j] * q.s[0] + d[3 * row + 1] * q.r[3 * j + 1] * q.s[1] +
                                   d[3 * row + 2] * q.r[3 * j + 2] * q.s[2];
        V jx = f.inverse * k[FX], jy = f.inverse * k[FY];
        V d_jx = key[0] * f.h[0] + key[1] * f.h[1] + key[2] * f.h[2];
        V d_jy = key[3] * f.h[3] + key[4] * f.h[4] + key[5] * f.h[5];
        V d_u = -jx * (key[0] * k[6] + key[1] * k[7] + key[2] * k[8]);
        V d_v = -jy * (key[3] * k[6] + key[4] * k[7] + key[5] * k[8]);
        d_u = ((f.u > k[XMIN]) & (f.u < k[XMAX]) ? d_u : V{}) + d_mx * k[FX];
        d_v = ((f.v > k[YMIN]) & (f.v < k[YMAX]) ? d_v : V{}) + d_my * k[FY];
        V d_z = sum(6 + 3) - (d_u * f.u + d_v * f.v + d_jx * jx + d_jy * jy) * f.inverse;
        d_u *= f.inverse, d_v *= f.inverse;
        for (int j = 0; j < 3; j++) give(g_means + 3 * i + j, 3, k[j] * d_u + k[3 + j] * d_v + k[6 + j] * d_z);
    }
}

template <class Job> static void each_tile(Context &c, Job job) {
    for (int tile = 0; tile < c.tiles; tile++) {
        int x0 = tile % c.columns * TILE, y0 = tile / c.columns * TILE;
        job(tile, x0, y0, std::min(x0 + TILE, c.width) - 1, std::min(y0 + TILE, c.height) - 1);
    }
}

extern "C" {
Context *make() { return new Context; }
void drop(Context *c) { delete c; }

// image: rgb, depth, alpha; planes of width × height.
void forward(Context *context, int64_t n, const float *means, const float *quats, const float *scales,
             const float *opacities, const float *colors, const float *view, const float *background, float floor,
             float *image) {
    Context &c = *context;
    memcpy(c.view, view, sizeof c.view);
    c.n = n, c.floor = floor, c.width = view[W], c.height = view[H];
    c.columns = (c.width + TILE - 1) / TILE, c.tiles = c.columns * ((c.height + TILE - 1) / TILE);
    c.record.resize(n * RECORD), c.boxes.resize(4 * n), c.order.resize(n), c.scratch.resize(n);
    c.offsets.resize(n + 1), c.starts.resize(c.tiles + 1), c.stops.resize(c.tiles);
    int64_t area = (int64_t)c.width * c.height;
    c.image.resize((F + 1) * area);
    project(c, means, quats, scales, opacities, colors);
    sort_and_offset(c);
    fill_lists(c);
    std::vector<float> buffer((F + 1) * PLANE + L);
    each_tile(c, [&](int tile, int x0, int y0, int x1, int y1) {
        c.stops[tile] = blend_tile(c, tile, x0, y0, x1, y1, buffer.data());
        for (int r = 0; r <= y1 - y0; r++) {
            float *to = &c.image[(int64_t)(y0 + r) * c.width + x0];
            const float *b = buffer.data() + r * PITCH;
            for (int x = 0; x <= x1 - x0; x++) to[F * area + x] = 1 - b[x];
            for (int j = 0; j < F; j++)
                for (int x = 0; x <= x1 - x0; x++)
                    to[j * area + x] = b[(j + 1) * PLANE + x] + (j < 3 ? background[j] * b[x] : 0);
        }
    });
    memcpy(image, c.image.data(), (F + 1) * area * sizeof(float));
}

void backward(Context *context, const float *means, const float *quats, const float *scales, const float *opacities,
              const float *g_image, float *g_means, float *g_quats, float *g_scales, float *g_opacities,
              float *g_colors) {
    Context &c = *context;
    if (c.partial.size() < (size_t)c.offsets[c.n] * SUMS) c.partial.resize(c.offsets[c.n] * SUMS);
    std::vector<float> buffer((F + 3) * PLANE + L);
    each_tile(c, [&](int tile, int x0, int y0, int x1, int y1) {
        unblend_tile(c, tile, x0, y0, x1, y1, g_image, buffer.data());
    });
    unproject(c, means, quats, scales, opacities, g_means, g_quats, g_scales, g_opacities, g_colors);
}
}

/* What the correction computes window by window and pixel by pixel, for float32 images.
 *
 * Optional: without a compiler at installation the functions of planes.py, normals.py and mixed.py that these
 * stand for are used, which say what is computed and why (test/test_kernels.py compares both).
 * A NaN makes a comparison false, as there.
 */
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && defined(__linux__)
/* chosen when the library is loaded: the wide registers of a processor of the last five or ten years, or none */
#define FOR_EACH_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FOR_EACH_PROCESSOR
#endif

#if defined(__GNUC__) && !defined(__clang__)
/* before a loop: what it writes, it does not read */
#define INDEPENDENT _Pragma("GCC ivdep")
#else
#define INDEPENDENT
#endif

enum { WINDOW = 5, STRIDE = 3, PIXELS = WINDOW * WINDOW };
/* rim_camera_ros.frame.Flag */
enum { LOW_AMPLITUDE = 1, SATURATED = 2, MIXED_PIXEL = 4, OUTSIDE_CALIBRATION = 8, NO_MEASUREMENT = 16 };
enum { INVALID = LOW_AMPLITUDE | SATURATED | NO_MEASUREMENT };
static const float SPREAD = 50.0f;

typedef struct {
    int64_t width, rows, columns, stride;
} Grid;

/* PlaneWindows: what does not change from frame to frame, (rows, stride) each */
typedef struct {
    const float *inverse[4], *mean_x, *mean_y, *tilt, *centre_z, *slopes[4];
    const int64_t *over;
} Geometry;

/* of one frame, (rows, stride) each */
typedef struct {
    float *mean, *along_row, *along_column, *residual, *x, *y, *z, *metre, *noise;
    uint8_t *good, *noisy;
} Windows;

/* _Fits.of; `columns` has room for four rows of the image */
FOR_EACH_PROCESSOR
static void fit(const Grid *grid, const float *values, const Windows *to, float *columns)
{
    const int64_t width = grid->width;
    float *restrict middle = columns, *restrict total = columns + width;
    float *restrict slope = columns + 2 * width, *restrict square = columns + 3 * width;
    for (int64_t r = 0; r < grid->rows; r++) {
        const float *restrict row = values + STRIDE * r * width;
        INDEPENDENT
        for (int64_t u = 0; u < width; u++) {
            const float centre = row[2 * width + u];
            const float above2 = row[u] - centre, above = row[width + u] - centre;
            const float below = row[3 * width + u] - centre, below2 = row[4 * width + u] - centre;
            middle[u] = centre;
            total[u] = above2 + above + below + below2;
            slope[u] = 2.0f * (below2 - above2) + below - above;
            square[u] = above2 * above2 + above * above + below * below + below2 * below2;
        }
        INDEPENDENT
        for (int64_t c = 0; c < grid->columns; c++) {
            const int64_t u = STRIDE * c, at = r * grid->stride + c;
            const float centre = middle[u + 2];
            float first = total[u + 2], along_row = 0.0f, along_column = slope[u + 2];
            float second = square[u + 2];
            for (int j = 0; j < WINDOW; j++) {
                if (j == 2)
                    continue;
                const float step = middle[u + j] - centre, sum = step * WINDOW + total[u + j];
                first += sum;
                along_row += (float)(j - 2) * sum;
                along_column += slope[u + j];
                second += square[u + j] + step * (sum + total[u + j]);
            }
            first /= PIXELS;
            along_row /= SPREAD;
            along_column /= SPREAD;
            to->mean[at] = centre + first;
            to->along_row[at] = along_row;
            to->along_column[at] = along_column;
            to->residual[at] = second - PIXELS * first * first
                               - SPREAD * (along_row * along_row + along_column * along_column);
        }
    }
}

/* The planes of all windows and which of them are good; returns how many good ones are too uncertain.
 * sigma [m] of one distance with the elements from row to row and from column to column (0 and 0: one number) */
FOR_EACH_PROCESSOR
int64_t rim_planes(const Grid *grid, const Geometry *geometry, const Windows *to, const float *inverse_depth,
                   const float *sigma, int64_t sigma_row, int64_t sigma_column, float factor, float excess,
                   float residual, float tilt, float *columns)
{
    int64_t noisy = 0;
    fit(grid, inverse_depth, to, columns);
    const float shrunk = 1.0f / (factor * factor) / 3.0f;
    const float least = (residual / factor) * (residual / factor), squared = excess * excess;
    const float uncertain = tilt * sqrtf(SPREAD);
    for (int64_t r = 0; r < grid->rows; r++) {
        INDEPENDENT
        for (int64_t c = 0; c < grid->columns; c++) {
            const int64_t at = r * grid->stride + c;
            const float *corner = sigma + STRIDE * (r * sigma_row + c * sigma_column);
            const float s0 = corner[4 * sigma_column], s1 = corner[2 * sigma_row + 2 * sigma_column];
            const float s2 = corner[4 * sigma_row];
            const float variance = (s0 * s0 + s1 * s1 + s2 * s2) * shrunk;
            const float mean = to->mean[at], row = to->along_row[at], column = to->along_column[at];
            const float x = geometry->inverse[0][at] * row + geometry->inverse[1][at] * column;
            const float y = geometry->inverse[2][at] * row + geometry->inverse[3][at] * column;
            const float metre = mean * mean * geometry->centre_z[at];
            float most = variance * squared;
            most = most < least ? least : most;
            const float noise = sqrtf(variance);
            const int good = to->residual[at] <= metre * metre * (float)(PIXELS - 3) * most;
            const int wide = good & (noise * metre * geometry->tilt[at] > uncertain * mean);
            to->x[at] = x;
            to->y[at] = y;
            to->z[at] = mean - x * geometry->mean_x[at] - y * geometry->mean_y[at];
            to->metre[at] = metre;
            to->noise[at] = noise;
            to->good[at] = (uint8_t)good;
            to->noisy[at] = (uint8_t)wide;
            noisy += wide;
        }
    }
    return noisy;
}

/* PlaneWindows._widen; `wider` are the entries of the wider windows, four numbers each */
void rim_widen(const Grid *grid, const Geometry *geometry, const Windows *to, const float *wider,
               float mean_sigmas, float near, float slope_sigmas, float slope)
{
    const float *const *slopes = geometry->slopes;
    for (int64_t r = 0; r < grid->rows; r++) {
        for (int64_t c = 0; c < grid->columns; c++) {
            const int64_t at = r * grid->stride + c;
            if (!to->noisy[at])
                continue;
            const float *plane = wider + 4 * geometry->over[at];
            const float x = plane[0], y = plane[1], z = plane[2];
            const float mean = x * geometry->mean_x[at] + y * geometry->mean_y[at] + z;
            const float metre = to->metre[at], noise = to->noise[at];
            const float by_noise = noise * mean_sigmas;
            const float most = metre * (noise * slope_sigmas + slope);
            if (fabsf(mean - to->mean[at]) <= metre * (by_noise < near ? near : by_noise)
                && fabsf(x * slopes[0][at] + y * slopes[1][at] - to->along_row[at]) <= most
                && fabsf(x * slopes[2][at] + y * slopes[3][at] - to->along_column[at]) <= most) {
                to->x[at] = x;
                to->y[at] = y;
                to->z[at] = z;
            }
        }
    }
}

/* The good window of the highest number within `reach` windows, -1 without one. */
static int64_t nearest(const Grid *grid, const uint8_t *good, int64_t r, int64_t c, int64_t reach)
{
    const int64_t last_row = r + reach < grid->rows ? r + reach : grid->rows - 1;
    const int64_t last = c + reach < grid->columns ? c + reach : grid->columns - 1;
    for (int64_t v = last_row; v >= 0 && v >= r - reach; v--)
        for (int64_t u = last; u >= 0 && u >= c - reach; u--)
            if (good[v * grid->stride + u])
                return v * grid->stride + u;
    return -1;
}

/* PlaneWindows._nearest_good; writes the entries, of which the first, of no window, stays NaN */
void rim_entries(const Grid *grid, const Windows *from, float *entries)
{
    for (int64_t r = 0; r < grid->rows; r++) {
        for (int64_t c = 0; c < grid->columns; c++) {
            int64_t at = r * grid->stride + c, source = at;
            float *entry = entries + 4 * (at + 1), sign = 1.0f;
            if (!from->good[at]) {
                sign = -1.0f;
                source = nearest(grid, from->good, r, c, 1);
                if (source < 0)
                    source = nearest(grid, from->good, r, c, 2);
            }
            if (source < 0) {
                entry[0] = entry[1] = entry[2] = entry[3] = NAN;
                continue;
            }
            const float x = from->x[source], y = from->y[source], z = from->z[source];
            entry[0] = x;
            entry[1] = y;
            entry[2] = z;
            entry[3] = sign / (sqrtf(x * x + y * y + z * z) + 1e-20f);
        }
    }
}

enum { UNSURE = 2 };

/* The planes of a row's pixels, 4 rows of numbers: the cosine, UNSURE where another plane may fit better. */
FOR_EACH_PROCESSOR
static void row_cosine(int64_t width, const float *restrict planes, const float *restrict rx,
                       const float *restrict ry, const float *restrict rz, const float *restrict distance,
                       const float *restrict sigma, float sure, float sigmas, float *restrict cosine)
{
    for (int64_t u = 0; u < width; u++) {
        const float inverse = planes[u] * rx[u] + planes[width + u] * ry[u] + planes[2 * width + u] * rz[u];
        const float sign = planes[3 * width + u], found = fabsf(inverse * sign), d = distance[u];
        const float miss = fabsf(1.0f / inverse - d), most = sigmas * sigma[u] > sure ? sigmas * sigma[u] : sure;
        const int unsure = !(sign > 0.0f) & (d > 0.0f) & !(miss < most);
        cosine[u] = unsure ? (float)UNSURE : found > 1.0f ? 1.0f : found;
    }
}

/* IncidenceEstimator._search for one pixel of distance d and ray r; `around` are the numbers of its neighbours,
 * `windows` apart. */
static float search(const float *own, const float *entries, const int64_t *around, int64_t windows, const float *r,
                    float d, float most)
{
    const float inverse = own[0] * r[0] + own[1] * r[1] + own[2] * r[2];
    const float miss = fabsf(1.0f / inverse - d);
    float least = INFINITY, best = 0.0f;
    for (int k = 0; k < 4; k++) {
        const float *other = entries + 4 * around[k * windows];
        if (!(other[3] > 0.0f))
            continue; /* holds a step itself */
        const float there = other[0] * r[0] + other[1] * r[1] + other[2] * r[2];
        const float error = fabsf(1.0f / there - d), cosine = fabsf(there * other[3]);
        if (error < least || (error == least && cosine > best)) {
            least = error;
            best = cosine;
        }
    }
    const float found = miss <= least ? fabsf(inverse * own[3]) : best;
    return !(fminf(least, miss) < most) ? NAN : found > 1.0f ? 1.0f : found;
}

/* IncidenceEstimator.cosine from the entries of the windows. rays: x, y, z of all pixels; window: of each pixel,
 * the same for all rows of the same first; neighbours: (4, windows + 1); planes: room for four rows */
void rim_cosine(int64_t height, int64_t width, const float *distance, const float *sigma, const float *rays,
                const float *entries, const int64_t *window, const int64_t *neighbours, int64_t windows,
                float near, float sure, float sigmas, float *planes, float *cosine)
{
    const int64_t count = height * width;
    for (int64_t v = 0, last = -1; v < height; v++) {
        const int64_t first = v * width;
        for (int64_t u = 0; window[first] != last && u < width; u++)
            for (int k = 0; k < 4; k++)
                planes[k * width + u] = entries[4 * window[first + u] + k];
        last = window[first];
        row_cosine(width, planes, rays + first, rays + count + first, rays + 2 * count + first, distance + first,
                   sigma + first, sure, sigmas, cosine + first);
        for (int64_t i = first; i < first + width; i++) {
            if (cosine[i] != (float)UNSURE)
                continue;
            const float ray[3] = {rays[i], rays[count + i], rays[2 * count + i]}, noise = sigmas * sigma[i];
            cosine[i] = search(entries + 4 * window[i], entries, neighbours + window[i], windows, ray, distance[i],
                               noise < near ? near : noise);
        }
    }
}

FOR_EACH_PROCESSOR
static void mixed_along(const float *restrict distance, const float *restrict sigma, int64_t count,
                        int64_t stride, float least, float sigmas, float share, uint8_t *restrict flags)
{
    for (int64_t i = 0; i < count; i++) {
        const float low = distance[i - 2 * stride], high = distance[i + 2 * stride];
        const float slopes = fabsf(low - distance[i - 3 * stride]) + fabsf(distance[i + 3 * stride] - high);
        const float step = high - low, excess = fabsf(step) - 4.0f * slopes;
        const float at = (distance[i] - low) * step, whole = step * step; /* a share without a division */
        const int mixed = (excess > least) & (excess > sigmas * sigma[i]) & (at > share * whole)
                          & (at < (1.0f - share) * whole);
        flags[i] |= mixed ? MIXED_PIXEL : 0;
    }
}

/* DistanceSolver: what does not change from frame to frame, but for the slope, of all pixels. `entries` of four
 * numbers each; `length` entries a row, of which y comes round (a power of two) or ends at the last; `beside` may be
 * NULL. */
typedef struct {
    const float *shift, *beside, *entries;
    const int32_t *row;
    float *slope, scale;
    int32_t length, wraps;
} Solver;

/* DistanceSolver.solve of `count` pixels from the one at `first`: y + value + slope * (distance from the entry's lower
 * edge) + by_phase * beside; `solved` may be y. */
FOR_EACH_PROCESSOR
void rim_solve(const Solver *by, int64_t first, int64_t count, const float *y, float *solved)
{
    const float *restrict shift = by->shift + first, *restrict entries = by->entries;
    const float *restrict beside = by->beside ? by->beside + first : NULL;
    const int32_t *restrict row = by->row + first;
    float *restrict slope = by->slope + first;
    const float scale = by->scale;
    const int32_t length = by->length, wraps = by->wraps;
    INDEPENDENT
    for (int64_t i = 0; i < count; i++) {
        const float at = y[i] * scale + shift[i], edge = floorf(at);
        int32_t entry = edge >= -2e9f && edge <= 2e9f ? (int32_t)edge : 0; /* NaN: any */
        if (wraps)
            entry &= length - 1;
        else
            entry = entry < 0 ? 0 : entry >= length ? length - 1 : entry;
        const float *restrict found = entries + 4 * (int64_t)(entry + row[i]);
        float value = found[0] + found[1] * (at - edge);
        if (beside)
            value += found[2] * beside[i];
        slope[i] = found[1];
        solved[i] = y[i] + value;
    }
}

/* What the 65,536 counts of the amplitude say; `amplitude` is NULL where it is the counts themselves. */
typedef struct {
    const float *term, *amplitude, *sigma;
    const uint8_t *flags;
} Table;

FOR_EACH_PROCESSOR
static void read_distances(int64_t count, const uint16_t *restrict raw, const uint16_t *restrict published,
                           const float *restrict term, float unit, float offset, float *restrict y)
{
    for (int64_t i = 0; i < count; i++) {
        const float metres = (float)raw[i] * unit - term[published[i]] - offset;
        y[i] = raw[i] ? metres : NAN;
    }
}

FOR_EACH_PROCESSOR
static void convert(int64_t count, const uint16_t *restrict from, float *restrict to)
{
    for (int64_t i = 0; i < count; i++)
        to[i] = (float)from[i];
}

FOR_EACH_PROCESSOR
static void look_up(int64_t count, const uint16_t *restrict at, const float *restrict table, float *restrict to)
{
    for (int64_t i = 0; i < count; i++)
        to[i] = table[at[i]];
}

FOR_EACH_PROCESSOR
static void subtract(int64_t count, const float *restrict map, float *restrict y)
{
    for (int64_t i = 0; i < count; i++)
        y[i] -= map[i];
}

/* Counts to distances [m] less offset, map (or NULL) and the amplitude's term, solved where `by` is not NULL; and to
 * amplitudes, and sigmas and flags (or NULL both). Returns all flags that are set somewhere. */
int32_t rim_read(int64_t count, const uint16_t *raw, const uint16_t *published, const Table *table, float unit,
                 float offset, const float *map, const Solver *by, float *y, float *amplitude, float *sigma,
                 uint8_t *flags)
{
    const int64_t block = 1 << 12; /* stays in the processor's nearest cache */
    int32_t all = 0;
    for (int64_t at = 0; at < count; at += block) {
        const int64_t size = count - at < block ? count - at : block;
        read_distances(size, raw + at, published + at, table->term, unit, offset, y + at);
        if (map)
            subtract(size, map + at, y + at);
        if (by)
            rim_solve(by, at, size, y + at, y + at);
        if (table->amplitude)
            look_up(size, published + at, table->amplitude, amplitude + at);
        else
            convert(size, published + at, amplitude + at);
        if (!flags)
            continue;
        look_up(size, published + at, table->sigma, sigma + at);
        for (int64_t i = at; i < at + size; i++) {
            flags[i] = (uint8_t)(table->flags[published[i]] | (raw[i] ? 0 : NO_MEASUREMENT));
            all |= flags[i];
        }
    }
    return all;
}

/* Folded.incidence_term of `count` pixels: t + b / distance from a table of pairs over sqrt(1 - cosine), whose first
 * pair is for pixels without a plane */
FOR_EACH_PROCESSOR
void rim_incidence(int64_t count, const float *restrict cosine, const float *restrict distance,
                   const float *restrict table, int32_t last, float *restrict term)
{
    for (int64_t i = 0; i < count; i++) {
        const float at = sqrtf(1.0f - cosine[i]) * (float)last + 1.5f;
        int32_t entry = at >= 0.0f ? (int32_t)at : 0;
        entry = entry > last + 1 ? last + 1 : entry;
        term[i] = table[2 * entry] + table[2 * entry + 1] / distance[i];
    }
}

/* PlaneTable.term of `count` pixels: base + slope * d + the sum of bend * |d - knot| over `inner` knots, with d
 * held between first and last; `bends` holds `inner` images */
FOR_EACH_PROCESSOR
void rim_plane_table(int64_t count, const float *restrict distance, const float *restrict base,
                     const float *restrict slope, int64_t inner, const float *restrict knots,
                     const float *restrict bends, float first, float last, float *restrict term)
{
    for (int64_t i = 0; i < count; i++) {
        float held = distance[i];
        held = held < first ? first : held;
        held = held > last ? last : held;
        term[i] = base[i] + held * slope[i];
    }
    for (int64_t k = 0; k < inner; k++) {
        const float *restrict bend = bends + k * count;
        const float knot = knots[k];
        for (int64_t i = 0; i < count; i++) {
            float held = distance[i];
            held = held < first ? first : held;
            held = held > last ? last : held;
            term[i] += bend[i] * fabsf(held - knot);
        }
    }
}

/* More turns than any distance has; NaN is not less. */
static const float FAR = 1e6f;

/* The nearest whole number of |x| < 2^22. */
static inline float whole(float x)
{
    const float shift = 12582912.0f; /* 1.5 * 2^23: the sum has no digits behind the point */
    return (x + shift) - shift;
}

/* Sine and cosine to 1e-7 by the polynomials of Cephes (Moshier 1989) within an eighth of a turn. */
FOR_EACH_PROCESSOR
static void row_to_image(int64_t width, const float *restrict distance, const float *restrict amplitude,
                         float turns, float *restrict real, float *restrict imaginary)
{
    for (int64_t u = 0; u < width; u++) {
        const float at = distance[u] * turns, turn = at - whole(at), quarter = whole(4.0f * turn);
        const float x = (turn - 0.25f * quarter) * 6.28318531f, z = x * x;
        const float sine = x + x * z * (-1.6666654611e-1f + z * (8.3321608736e-3f - z * 1.9515295891e-4f));
        const float cosine = 1.0f - 0.5f * z
                             + z * z * (4.166664568e-2f + z * (-1.388731625e-3f + z * 2.443315712e-5f));
        const int odd = fabsf(quarter) == 1.0f, back = fabsf(quarter) == 2.0f;
        const float light = fabsf(at) < FAR ? amplitude[u] : 0.0f, turned = back ? -light : light;
        const float along = odd ? -quarter * sine : cosine, across = odd ? quarter * cosine : sine;
        real[u] = light == 0.0f ? 0.0f : turned * along;
        imaginary[u] = light == 0.0f ? 0.0f : turned * across;
    }
}

/* OpticsUndo: distances [m] and amplitudes to the complex image (height, 2, width); pixels without a distance are
 * dark. */
void rim_to_image(int64_t height, int64_t width, const float *distance, const float *amplitude, float ambiguity,
                  float *image)
{
    for (int64_t v = 0; v < height; v++) {
        float *row = image + 2 * v * width;
        row_to_image(width, distance + v * width, amplitude + v * width, 1.0f / ambiguity, row, row + width);
    }
}

/* The angle in turns, to 3e-8, by the polynomial of Cephes; `length` of the vector, `inverse` gets 1 over it. */
static inline float turn_of(float y, float x, float length, float *inverse)
{
    const float ax = fabsf(x), ay = fabsf(y);
    const float low = ay < ax ? ay : ax, high = ay < ax ? ax : ay;
    /* tan(pi/8): beyond it 45 degrees and the rest */
    const int far = low > 0.414213562f * high;
    const float top = far ? low - high : low, bottom = far ? low + high : high;
    const float both = length > 0.0f ? 1.0f / (bottom * length) : 0.0f; /* of two divisions */
    const float t = top * length * both, z = t * t;
    const float eighths = t + t * z * (-3.33329491539e-1f + z * (1.99777106478e-1f + z * (-1.38776856032e-1f
                                                                             + z * 8.05374449538e-2f)));
    const float octant = eighths * 0.159154943f + (far ? 0.125f : 0.0f);
    const float quadrant = ay > ax ? 0.25f - octant : octant, half = x < 0.0f ? 0.5f - quadrant : quadrant;
    *inverse = bottom * both;
    return y < 0.0f ? -half : half;
}

FOR_EACH_PROCESSOR
static void row_from_image(int64_t width, const float *restrict real, const float *restrict imaginary,
                           const float *restrict before, float ambiguity, int32_t wraps, float direct,
                           float *restrict distance, float *restrict amplitude, float *restrict gain)
{
    const float turns = 1.0f / ambiguity, scale = 1.0f / direct;
    for (int64_t u = 0; u < width; u++) {
        const float light = sqrtf(real[u] * real[u] + imaginary[u] * imaginary[u]);
        float inverse;
        const float was = distance[u] * turns, turn = turn_of(imaginary[u], real[u], light, &inverse);
        const float change = turn - was, nearest = was + (change - whole(change));
        const float positive = turn < 0.0f ? turn + 1.0f : turn, within = positive < 1.0f ? positive : 0.0f;
        const float found = (wraps ? within : nearest) * ambiguity;
        const int known = fabsf(was) < FAR;
        distance[u] = known ? found : NAN;
        amplitude[u] = light;
        gain[u] = known ? before[u] * scale * inverse : 0.0f;
    }
}

FOR_EACH_PROCESSOR
static void row_of_emitter(int64_t width, const float *restrict along, float square, float *restrict distance)
{
    const float shortest = 0.5f * sqrtf(square);
    for (int64_t u = 0; u < width; u++) {
        const float half = distance[u], twice = 4.0f * half, found = (half * twice - square) / (twice + along[u]);
        distance[u] = half <= shortest ? NAN : found;
    }
}

/* OpticsUndo: the image without stray light to distance, which holds the delivered one before, to amplitude, and to
 * gain, the amplitude before over it and over `direct`. `along`, of the emitter beside the lens, may be NULL. */
void rim_from_image(int64_t height, int64_t width, const float *image, const float *before, float ambiguity,
                    int32_t wraps, float direct, const float *along, float square, float *distance,
                    float *amplitude, float *gain)
{
    for (int64_t v = 0; v < height; v++) {
        const int64_t at = v * width;
        const float *row = image + 2 * at;
        row_from_image(width, row, row + width, before + at, ambiguity, wraps, direct, distance + at,
                       amplitude + at, gain + at);
        if (along)
            row_of_emitter(width, along + at, square, distance + at);
    }
}

/* What `rim_judge` is told, NULL where there is nothing: (height, width) each, `always` are flags */
typedef struct {
    const float *amplitude, *gain, *slope, *cosine;
    const uint8_t *always;
    float minimum, slope_scale, spread, least, greatest, step, sigmas, share;
    int32_t everywhere;
} Judged;

FOR_EACH_PROCESSOR
static void row_judged(int64_t width, const Judged *by, int64_t first, const float *restrict distance,
                       float *restrict sigma, uint8_t *restrict flags)
{
    const float *restrict amplitude = by->amplitude + first;
    const float minimum = by->minimum, least = by->least, greatest = by->greatest;
    const int32_t everywhere = by->everywhere;
    if (by->gain)
        for (int64_t u = 0; u < width; u++)
            sigma[u] *= by->gain[first + u];
    if (by->slope)
        for (int64_t u = 0; u < width; u++)
            sigma[u] *= 1.0f + by->slope[first + u] * by->slope_scale;
    if (by->cosine)
        for (int64_t u = 0; u < width; u++) {
            const float more = by->cosine[first + u] == by->cosine[first + u] ? 0.0f : by->spread;
            sigma[u] = sqrtf(sigma[u] * sigma[u] + more * more);
        }
    for (int64_t u = 0; u < width; u++) {
        const float d = distance[u];
        const int32_t low = amplitude[u] < minimum ? LOW_AMPLITUDE : 0, flag = flags[u] | low;
        const int32_t nowhere = d != d && !(flag & INVALID) ? NO_MEASUREMENT : 0;
        const int32_t outside = (d < least) | (d > greatest) ? OUTSIDE_CALIBRATION : 0;
        flags[u] = (uint8_t)(flag | nowhere | outside | everywhere);
    }
    if (by->always)
        for (int64_t u = 0; u < width; u++)
            flags[u] |= by->always[first + u];
}

FOR_EACH_PROCESSOR
static void row_without_invalid(int64_t width, const uint8_t *restrict flags, float *restrict distance,
                                float *restrict sigma)
{
    for (int64_t u = 0; u < width; u++) {
        const int invalid = flags[u] & INVALID;
        distance[u] = invalid ? NAN : distance[u];
        sigma[u] = invalid ? NAN : sigma[u];
    }
}

/* Correction._sigma and _flags, with mixed_pixels: sigma and flags (height, width) hold what the amplitudes say of
 * them before; distance and sigma are NaN in the end where they are not valid. */
void rim_judge(int64_t height, int64_t width, const Judged *by, float *distance, float *sigma, uint8_t *flags)
{
    const int64_t reach = 3; /* rows that mixed pixels look at */
    for (int64_t v = 0; v < height + reach; v++) {
        const int64_t at = v * width, done = at - reach * width;
        if (v < height) {
            row_judged(width, by, at, distance + at, sigma + at, flags + at);
            if (width > 2 * reach)
                mixed_along(distance + at + reach, sigma + at + reach, width - 2 * reach, 1, by->step, by->sigmas,
                            by->share, flags + at + reach);
            if (v >= reach && v < height - reach)
                mixed_along(distance + at, sigma + at, width, width, by->step, by->sigmas, by->share, flags + at);
        }
        if (v >= reach)
            row_without_invalid(width, flags + done, distance + done, sigma + done);
    }
}

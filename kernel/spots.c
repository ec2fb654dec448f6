/* Sub-pixel centres of spots: images/background.py, images/centroid.py and images/sharp_spots.py. */

#include "kernel.h"

/* NaN of a stays NaN */
static double least(double a, double b) { return b < a ? b : a; }
static double most(double a, double b) { return b > a ? b : a; }
static double within(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

/* k-th of n values, which are reordered: smaller ones before it, larger ones behind it */
static double kth(double *v, int n, int k)
{
    int low = 0, high = n - 1;
    while (low < high) {
        double pivot = v[(low + high) / 2];
        int i = low, j = high;
        while (i <= j) {
            while (i < high && v[i] < pivot) i++;
            while (j > low && v[j] > pivot) j--;
            if (i <= j) {
                double swapped = v[i];
                v[i++] = v[j];
                v[j--] = swapped;
            }
        }
        if (k <= j) high = j;
        else if (k >= i) low = i;
        else break;
    }
    return v[k];
}

static double median(double *v, int n)
{
    double low = kth(v, n, (n - 1) / 2), high = low;
    if (n % 2 == 0) {
        high = v[n / 2];
        for (int k = n / 2 + 1; k < n; k++) high = least(high, v[k]);
    }
    return (low + high) / 2;
}

/* A window of h rows and w columns, and memory to work in. Borders are left and right (h each), top and bottom (w). */
typedef struct {
    int h, w;
    const double *light;
    Py_ssize_t stride;     /* doubles between rows of `light` and `signal` */
    const char *inner;     /* bright pixels of the spot, rows `stride` apart */
    double *signal;
    double *step, *other;  /* h * w each */
    double *sides, *work;  /* 2 (h + w) each */
    double *ring;          /* 3 * 2 (h + w) */
    double *profiles[2];   /* 6 * w and 6 * h: powers 0 to 2 of a window, and their squares; x, y */
    double *columns;       /* 3 * w */
} Window;

/* Light less `step` (or NULL) less a Coons patch, to `out`; returns the noise of a pixel. */
static double without_coons_patch(Window *s, const double *step, double levels, double *out, Py_ssize_t out_stride)
{
    int h = s->h, w = s->w, n = 2 * (h + w), count = 0;
#define LIGHT(i, j) (s->light[(i) * s->stride + (j)] - (step ? step[(i) * w + (j)] : 0.0))
    double *left = s->sides, *right = left + h, *top = right + h, *bottom = top + w, *outer = s->ring;
    for (int i = 0; i < h; i++) {
        outer[i] = LIGHT(i, 0), left[i] = (outer[i] + LIGHT(i, 1)) / 2;
        outer[h + i] = LIGHT(i, w - 1), right[i] = (outer[h + i] + LIGHT(i, w - 2)) / 2;
    }
    for (int j = 0; j < w; j++) {
        outer[2 * h + j] = LIGHT(0, j), top[j] = (outer[2 * h + j] + LIGHT(1, j)) / 2;
        outer[2 * h + w + j] = LIGHT(h - 1, j), bottom[j] = (outer[2 * h + w + j] + LIGHT(h - 2, j)) / 2;
    }
    for (int k = 0; k + 1 < n; k++)
        if (k != h - 1 && k != 2 * h - 1 && k != 2 * h + w - 1) s->work[count++] = fabs(outer[k + 1] - outer[k]);
    double noise = 1.4826 / sqrt(2.0) * median(s->work, count);
    memcpy(s->work, s->sides, n * sizeof(double));
    double middle = median(s->work, n);
    for (int k = 0; k < n; k++) s->sides[k] = within(s->sides[k], middle - levels, middle + levels);
    double a = (left[0] + top[0]) / 2, b = (left[h - 1] + bottom[0]) / 2;
    double c = (right[0] + top[w - 1]) / 2, d = (right[h - 1] + bottom[w - 1]) / 2;
    for (int i = 0; i < h; i++) {
        double down = (double)i / (h - 1), up = 1 - down;
        double at_left = left[i] - (a * up + b * down), at_right = right[i] - (c * up + d * down);
        for (int j = 0; j < w; j++) {
            double across = (double)j / (w - 1);
            double patch = at_left * (1 - across) + at_right * across;
            out[i * out_stride + j] = LIGHT(i, j) - patch - (up * top[j] + down * bottom[j]);
        }
    }
#undef LIGHT
    return noise < sqrt(1 / 12.0) ? sqrt(1 / 12.0) : noise;
}

/* Find a straight step between a bright and a dark piece of the border; returns whether there is one, in `s->step`. */
static int find_step(Window *s, double noise)
{
    const double contrast = 4.0 * noise; /* STEP_CONTRAST */
    int h = s->h, w = s->w, n = 2 * (h + w) - 4, k = 0, turns = 0, at[2] = {0, 0};
    double lowest = INFINITY, highest = -INFINITY, *value = s->ring, *x = value + 2 * (h + w), *y = x + 2 * (h + w);
    for (int i = 0; i < 2 * (h + w); i++) lowest = least(lowest, s->sides[i]), highest = most(highest, s->sides[i]);
    if (!(highest - lowest > contrast)) return 0;
    for (int j = 0; j < w; j++, k++) value[k] = s->sides[2 * h + j], x[k] = j, y[k] = 0;
    for (int i = 1; i < h - 1; i++, k++) value[k] = s->sides[h + i], x[k] = w - 1, y[k] = i;
    for (int j = w - 1; j >= 0; j--, k++) value[k] = s->sides[2 * h + w + j], x[k] = j, y[k] = h - 1;
    for (int i = h - 2; i > 0; i--, k++) value[k] = s->sides[i], x[k] = 0, y[k] = i;
    for (k = 0; k < n; k++) x[k] = within(x[k], 0.5, w - 1.5), y[k] = within(y[k], 0.5, h - 1.5);
    memcpy(s->work, value, n * sizeof(double));
    double low = kth(s->work, n, n / 8), high = kth(s->work, n, n - 1 - n / 8), middle = (low + high) / 2;
    if (!(high - low > contrast)) return 0;
    for (k = 0; k < n; k++)
        if ((value[k] > middle) != (value[(k + 1) % n] > middle)) {
            if (turns < 2) at[turns] = k;
            turns++;
        }
    if (turns != 2) return 0;
    double end_x[2], end_y[2];
    for (int e = 0; e < 2; e++) {
        int before = at[e], after = (at[e] + 1) % n;
        double share = (middle - value[before]) / (value[after] - value[before]);
        end_x[e] = x[before] * (1 - share) + x[after] * share;
        end_y[e] = y[before] * (1 - share) + y[after] * share;
    }
    double along_x = end_x[1] - end_x[0], along_y = end_y[1] - end_y[0], length = most(hypot(along_x, along_y), 1.0);
    double normal_x = -along_y / length, normal_y = along_x / length;
    double offset = normal_x * end_x[0] + normal_y * end_y[0], side = 0, bright = 0, dark = 0;
    int count = 0;
    for (k = 0; k < n; k++) {
        int is_bright = value[k] > middle;
        side += (normal_x * x[k] + normal_y * y[k] - offset) * (is_bright - 0.5);
        count += is_bright;
        *(is_bright ? &bright : &dark) += value[k];
    }
    if (!(side > 0)) normal_x = -normal_x, normal_y = -normal_y, offset = -offset;
    double height = bright / count - dark / (n - count);
    for (int i = 0; i < h; i++)
        for (int j = 0; j < w; j++)
            s->step[i * w + j] = height * within(normal_x * j + normal_y * i - offset + 0.5, 0.0, 1.0);
    return 1;
}

static double without_background(Window *s, double levels)
{
    int h = s->h, w = s->w, reach = 2 /* REACH */;
    double noise = without_coons_patch(s, NULL, levels, s->signal, s->stride);
    for (int i = 0; i < h; i++)
        for (int j = 0; j < w; j++)
            if (!(s->light[i * s->stride + j] < 250.0 /* SATURATED */)) return noise;
    if (!find_step(s, noise)) return noise;
    double stepped_noise = without_coons_patch(s, s->step, levels, s->other, w), better = 0;
    char *row = (char *)s->work, *column = (char *)s->ring; /* True where the spot's light reaches */
    for (int i = 0; i < h; i++) row[i] = 0;
    for (int j = 0; j < w; j++) column[j] = 0;
    for (int i = 0; i < h; i++)
        for (int j = 0; j < w; j++)
            if (s->inner[i * s->stride + j]) {
                for (int k = i - reach; k <= i + reach; k++) if (k >= 0 && k < h) row[k] = 1;
                for (int k = j - reach; k <= j + reach; k++) if (k >= 0 && k < w) column[k] = 1;
            }
    for (int i = 0; i < h; i++)
        for (int j = 0; j < w; j++)
            if (!(row[i] && column[j])) {
                double with = s->signal[i * s->stride + j], without = s->other[i * w + j];
                better += with * with - without * without;
            }
    if (!(better > 0)) return noise;
    for (int i = 0; i < h; i++) memcpy(s->signal + i * s->stride, s->other + i * w, w * sizeof(double));
    return stepped_noise;
}

/* Centres. */

typedef struct {
    double centre[2], covariance[4], shape[4], flux, noise, peak, found;
} Spot;

static void profile(double *out, int n, double centre, double variance)
{
    for (int k = 0; k < n; k++) {
        double off = k - centre;
        out[k] = exp(off * off * (-0.5 / variance));
        out[n + k] = out[k] * off;
        out[2 * n + k] = out[n + k] * off;
    }
}

/* Moments out[a][b] of a window weighed by profiles y (3, h) along the rows and x (3, w) along the columns. */
static void moments(const Window *s, const double *x, const double *y, int positive, double out[3][3])
{
    int h = s->h, w = s->w;
    double *sums = s->columns;
    memset(sums, 0, 3 * w * sizeof(double));
    for (int i = 0; i < h; i++) {
        const double *row = s->signal + i * s->stride;
        for (int j = 0; j < w; j++) {
            double value = positive && !(row[j] > 0) ? 0.0 : row[j];
            sums[j] += y[i] * value, sums[w + j] += y[h + i] * value, sums[2 * w + j] += y[2 * h + i] * value;
        }
    }
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) {
            out[a][b] = 0;
            for (int j = 0; j < w; j++) out[a][b] += sums[a * w + j] * x[b * w + j];
        }
}

/* Covariance of the first moments from the noise of the pixels and of the background. */
static Symmetric moments_covariance(const Window *s, double noise, double shot_gain)
{
    int size[2] = {s->w, s->h};
    double sums[2][3] = {{0}}, whole[2] = {0}, shot[3][3];
    for (int axis = 0; axis < 2; axis++) {
        int n = size[axis];
        double *p = s->profiles[axis], *squares = p + 3 * n;
        for (int k = 0; k < n; k++) {
            squares[k] = p[k] * p[k], squares[n + k] = p[k] * p[n + k], squares[2 * n + k] = p[n + k] * p[n + k];
            for (int power = 0; power < 3; power++) sums[axis][power] += squares[power * n + k];
            whole[axis] += p[k];
        }
    }
    moments(s, s->profiles[0] + 3 * s->w, s->profiles[1] + 3 * s->h, 1, shot);
    double dark = noise * noise;
    return (Symmetric){
        sums[0][2] * (sums[1][0] + whole[1] * whole[1] / 4) * dark + shot_gain * shot[0][2],
        sums[0][1] * sums[1][1] * dark + shot_gain * shot[1][1],
        sums[1][2] * (sums[0][0] + whole[0] * whole[0] / 4) * dark + shot_gain * shot[2][0],
    };
}

static int is_near(const Window *s, int i, int j)
{
    for (int k = i - 1; k <= i + 1; k++)
        for (int l = j - 1; l <= j + 1; l++)
            if (k >= 0 && l >= 0 && k < s->h && l < s->w && s->inner[k * s->stride + l]) return 1;
    return 0;
}

/* Take the mean with the centre of mass of the bright pixels and those beside them, or that alone if none fits. */
static void with_centre_of_mass(const Window *s, double shot_gain, int fits, Spot *spot)
{
    double total = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0, dark = spot->noise * spot->noise;
    for (int pass = 0; pass < 2; pass++) {
        for (int i = 0; i < s->h; i++)
            for (int j = 0; j < s->w; j++)
                if (is_near(s, i, j)) {
                    double lit = most(s->signal[i * s->stride + j], 0.0), variance = dark + shot_gain * lit;
                    if (!pass) total += lit, x += lit * j, y += lit * i;
                    else xx += variance * (j - x) * (j - x), xy += variance * (j - x) * (i - y), yy += variance * (i - y) * (i - y);
                }
        if (!pass) total = most(total, 1e-9), x /= total, y /= total;
    }
    double mass[2] = {x, y}, own[4] = {xx, xy, xy, yy};
    for (int k = 0; k < 2; k++) spot->centre[k] = fits ? (spot->centre[k] + mass[k]) / 2 : mass[k];
    for (int k = 0; k < 4; k++) {
        own[k] /= total * total;
        spot->covariance[k] = fits ? (spot->covariance[k] + own[k]) / 2 : own[k];
    }
}

static double half_difference(const Symmetric *s) { return hypot((s->xx - s->yy) / 2, s->xy); }

static Symmetric rough_shape(const Window *s)
{
    double n = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0;
    for (int i = 0; i < s->h; i++)
        for (int j = 0; j < s->w; j++)
            if (s->inner[i * s->stride + j]) n++, x += j, y += i, xx += j * j, xy += i * j, yy += i * i;
    n = most(n, 1.0), x /= n, y /= n;
    return (Symmetric){2 * (xx / n - x * x) + 0.4, 2 * (xy / n - x * y), 2 * (yy / n - y * y) + 0.4};
}

/* Measure one spot, from an initial centre and shape (6 values: x, y, and a matrix) or from its bright pixels. */
static void measure(Window *s, double levels, double shot_gain, const double *begin, Spot *spot)
{
    spot->noise = without_background(s, levels);
    Symmetric start = rough_shape(s), shape = start;
    spot->peak = 0;
    for (int i = 0; i < s->h; i++)
        for (int j = 0; j < s->w; j++)
            if (s->inner[i * s->stride + j]) spot->peak = most(spot->peak, s->signal[i * s->stride + j]);
    double u = 0, v = 0, total = 0, gain[4] = {2, 0, 0, 2};
    if (begin) u = begin[0], v = begin[1], shape = (Symmetric){begin[2], begin[3], begin[5]};
    else {
        for (int i = 0; i < s->h; i++)
            for (int j = 0; j < s->w; j++)
                if (s->inner[i * s->stride + j]) {
                    double lit = s->signal[i * s->stride + j];
                    total += lit, u += lit * j, v += lit * i;
                }
        u /= most(total, 1e-9), v /= most(total, 1e-9);
    }
    for (int iteration = 0; iteration < 12 /* MAX_ITERATIONS */; iteration++) {
        double m[3][3];
        profile(s->profiles[0], s->w, u, shape.xx), profile(s->profiles[1], s->h, v, shape.yy);
        moments(s, s->profiles[0], s->profiles[1], 0, m);
        total = m[0][0];
        double flux = most(total, 1e-9), x = m[0][1] / flux, y = m[1][0] / flux;
        double seen_xx = m[0][2] / flux - x * x, seen_xy = m[1][1] / flux - x * y, seen_yy = m[2][0] / flux - y * y;
        double inverse_x = 1 / shape.xx, inverse_y = 1 / shape.yy, determinant = seen_xx * seen_yy - seen_xy * seen_xy;
        double scale = 1 / ((1 - seen_xx * inverse_x) * (1 - seen_yy * inverse_y)
                            - seen_xy * inverse_x * seen_xy * inverse_y);
        Symmetric found = {(seen_xx - determinant * inverse_y) * scale, seen_xy * scale,
                           (seen_yy - determinant * inverse_x) * scale};
        double half = (found.xx + found.yy) / 2, apart = half_difference(&found);
        if (!(half - apart >= 0.25 && half + apart < 400.0)) found = start; /* MIN_VARIANCE, MAX_VARIANCE */
        gain[0] = found.xx * inverse_x + 1, gain[1] = found.xy * inverse_y;
        gain[2] = found.xy * inverse_x, gain[3] = found.yy * inverse_y + 1;
        double step_u = gain[0] * x + gain[1] * y, step_v = gain[3] * y + gain[2] * x;
        u += within(step_u, -1.0, 1.0), v += within(step_v, -1.0, 1.0);
        shape = found;
        if (!(most(fabs(step_u), fabs(step_v)) >= 1e-3 && total > 0)) break; /* CONVERGED */
    }
    profile(s->profiles[0], s->w, u, shape.xx), profile(s->profiles[1], s->h, v, shape.yy);
    Symmetric c = moments_covariance(s, spot->noise, shot_gain);
    double p = gain[0] * c.xx + gain[1] * c.xy, q = gain[0] * c.xy + gain[1] * c.yy;
    double r = gain[2] * c.xx + gain[3] * c.xy, t = gain[2] * c.xy + gain[3] * c.yy;
    double covariance[4] = {p * gain[0] + q * gain[1], p * gain[2] + q * gain[3],
                            r * gain[0] + t * gain[1], r * gain[2] + t * gain[3]};
    for (int k = 0; k < 4; k++) spot->covariance[k] = covariance[k] / most(total * total, 1e-9);
    spot->centre[0] = u, spot->centre[1] = v;
    int fits = shape.xx != start.xx || shape.xy != start.xy || shape.yy != start.yy;
    double limit = fits ? 0.8 : 1.2; /* SHARP, TOO_SHARP */
    if ((shape.xx + shape.yy) / 2 - half_difference(&shape) < limit * limit)
        with_centre_of_mass(s, shot_gain, fits, spot);
    double matrix[4] = {shape.xx, shape.xy, shape.xy, shape.yy};
    memcpy(spot->shape, matrix, sizeof matrix);
    spot->flux = total * sqrt((4 * shape.xx * shape.yy - shape.xy * shape.xy) / (shape.xx * shape.yy));
    spot->found = total > 0 && isfinite(spot->centre[0]) && isfinite(spot->centre[1]);
    for (int k = 0; k < 4; k++) spot->found = spot->found && isfinite(spot->covariance[k]);
}

/* Get a C-contiguous buffer of n elements of a size, or set an error. */
static int take(PyObject *object, Py_buffer *view, int writable, Py_ssize_t size, Py_ssize_t n)
{
    if (PyObject_GetBuffer(object, view, writable ? PyBUF_CONTIG : PyBUF_CONTIG_RO) < 0) return -1;
    if (view->itemsize == size && view->len == n * size) return 0;
    PyErr_SetString(PyExc_ValueError, "an array of another type or size was expected");
    PyBuffer_Release(view);
    return -1;
}

/* measure_spots(n, side, light, size, inner, begin, signal, out, levels, shot_gain): see images/centroid.py; `begin` is
   None or (n, 6): centres and shapes; written are `signal` (n, side, side) and `out` (n, 14), a Spot a row. */
PyObject *measure_spots(PyObject *module, PyObject *args)
{
    enum { LIGHT, SIZE, INNER, BEGIN, SIGNAL, OUT, ARRAYS };
    PyObject *objects[ARRAYS], *result = NULL;
    Py_buffer views[ARRAYS] = {{0}};
    Py_ssize_t n, side;
    double levels, shot_gain, *memory = NULL;
    if (!PyArg_ParseTuple(args, "nnOOOOOOdd", &n, &side, &objects[LIGHT], &objects[SIZE], &objects[INNER],
                          &objects[BEGIN], &objects[SIGNAL], &objects[OUT], &levels, &shot_gain)) return NULL;
    if (n < 0 || side < 2 || side > 30000 || n > PY_SSIZE_T_MAX / 64 / (side * side)) {
        PyErr_SetString(PyExc_ValueError, "a window has a side of 2 to 30000 pixels");
        return NULL;
    }
    const Py_ssize_t square = side * side, item[ARRAYS] = {8, 8, 1, 8, 8, 8};
    const Py_ssize_t count[ARRAYS] = {n * square, 2 * n, n * square, 6 * n, n * square, 14 * n};
    for (int k = 0; k < ARRAYS; k++)
        if (objects[k] != Py_None && take(objects[k], &views[k], k >= SIGNAL, item[k], count[k]) < 0) goto end;
    for (int k = 0; k < ARRAYS; k++)
        if (k != BEGIN && !views[k].obj) {
            PyErr_SetString(PyExc_TypeError, "only the initial centres and shapes may be None");
            goto end;
        }
    memory = malloc((2 * square + 35 * side) * sizeof(double));
    if (!memory) {
        PyErr_NoMemory();
        goto end;
    }
    Window s = {.stride = side, .step = memory, .other = memory + square};
    double *rest = memory + 2 * square;
    s.sides = rest, s.work = rest + 4 * side, s.ring = rest + 8 * side;
    s.profiles[0] = rest + 20 * side, s.profiles[1] = rest + 26 * side, s.columns = rest + 32 * side;
    memset(views[SIGNAL].buf, 0, views[SIGNAL].len);
    for (Py_ssize_t k = 0; k < n; k++) {
        const int64_t *size = (const int64_t *)views[SIZE].buf + 2 * k;
        if (size[0] < 2 || size[1] < 2 || size[0] > side || size[1] > side) {
            PyErr_SetString(PyExc_ValueError, "a window is larger than its array, or smaller than two pixels");
            goto end;
        }
        s.w = (int)size[0], s.h = (int)size[1];
        s.light = (const double *)views[LIGHT].buf + k * square;
        s.inner = (const char *)views[INNER].buf + k * square;
        s.signal = (double *)views[SIGNAL].buf + k * square;
        const double *begin = views[BEGIN].obj ? (const double *)views[BEGIN].buf + 6 * k : NULL;
        measure(&s, levels, shot_gain, begin, (Spot *)views[OUT].buf + k);
    }
    result = Py_NewRef(Py_None);
end:
    free(memory);
    for (int k = 0; k < ARRAYS; k++)
        if (views[k].obj) PyBuffer_Release(&views[k]);
    return result;
}

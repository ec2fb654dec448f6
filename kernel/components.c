/* Bright components of an image: images/components.py. */

#include "kernel.h"

typedef struct { int left, top, right, bottom; } Box; /* right and bottom excluded */
typedef struct { Box box; int64_t pixels, x, y; } Component;

/* Collect the component of a pixel (flat index), whose pixels are cleared; `stack` holds as many as there are pixels. */
static Component component_of(uint8_t *above, int w, int h, int32_t *stack, int32_t pixel)
{
    Component c = {{w, h, 0, 0}, 0, 0, 0};
    Py_ssize_t count = 0;
    stack[count++] = pixel, above[pixel] = 0;
    while (count) {
        int x, y;
        pixel = stack[--count], y = pixel / w, x = pixel - y * w;
        c.pixels++, c.x += x, c.y += y;
        if (x < c.box.left) c.box.left = x;
        if (y < c.box.top) c.box.top = y;
        if (x >= c.box.right) c.box.right = x + 1;
        if (y >= c.box.bottom) c.box.bottom = y + 1;
        for (int l = y > 0 ? y - 1 : 0; l <= y + 1 && l < h; l++)
            for (int k = x > 0 ? x - 1 : 0; k <= x + 1 && k < w; k++)
                if (above[l * w + k]) stack[count++] = l * w + k, above[l * w + k] = 0;
    }
    return c;
}

static int before(int a) { return a < 0 ? -((1 - a) / 2) : a / 2; } /* half of a, rounded down */

static int clamp(int a, int low, int high) { return a > high ? high : a < low ? low : a; }

static Box window_of(Box own, int w, int h)
{
    static const int sizes[] = {11, 15, 21, 31, 45, 63};
    int width = own.right - own.left, height = own.bottom - own.top, size = (width > height ? width : height) + 6;
    for (int k = 0; k < 6; k++)
        if (size <= sizes[k]) {
            size = sizes[k];
            break;
        }
    int x = own.left + before(width - size), y = own.top + before(height - size);
    x = x > w - size ? w - size : x, y = y > h - size ? h - size : y;
    x = x < 0 ? 0 : x, y = y < 0 ? 0 : y;
    return (Box){x, y, x + size, y + size};
}

/* Pixels of a box, as far as it lies in the light, that are brighter than a limit. */
static int64_t bright_in(const uint8_t *light, Py_ssize_t stride, Box box, int w, int h, int limit)
{
    int64_t count = 0;
    for (int i = box.top; i < box.bottom && i < h; i++)
        for (int j = box.left; j < box.right && j < w; j++) count += light[i * stride + j] > limit;
    return count;
}

/* find_bright(light, box, levels, min_area, max_area): see images/components.py. */
PyObject *find_bright(PyObject *module, PyObject *args)
{
    const int rim = 4, compact_percent = 60, max_led = 14; /* RIM, COMPACT, MAX_LED_SIZE */
    PyObject *object, *found = NULL;
    Py_buffer view;
    Box box, area;
    double levels;
    long long min_area, max_area;
    uint8_t *above = NULL;
    int32_t *stack = NULL;
    if (!PyArg_ParseTuple(args, "O(iiii)dLL", &object, &box.left, &box.top, &box.right, &box.bottom, &levels,
                          &min_area, &max_area)) return NULL;
    if (PyObject_GetBuffer(object, &view, PyBUF_STRIDED_RO) < 0) return NULL;
    if (view.ndim != 2 || view.itemsize != 1 || (view.shape[1] > 1 && view.strides[1] != 1)
        || view.shape[0] * view.shape[1] > INT32_MAX / 2) {
        PyErr_SetString(PyExc_ValueError, "the light is an array (h, w) of bytes with rows in one piece");
        goto end;
    }
    int w = (int)view.shape[1], h = (int)view.shape[0];
    const uint8_t *light = view.buf;
    Py_ssize_t stride = view.strides[0];
    Box whole = {0, 0, w, h};
    box = (Box){clamp(box.left, 0, w), clamp(box.top, 0, h), clamp(box.right, 0, w), clamp(box.bottom, 0, h)};
    area = (Box){clamp(box.left - rim, 0, w), clamp(box.top - rim, 0, h), clamp(box.right + rim, 0, w),
                 clamp(box.bottom + rim, 0, h)};
    if (area.right <= area.left || area.bottom <= area.top) {
        found = Py_BuildValue("d[]", levels);
        goto end;
    }
    /* the median of some fifty pixels */
    int width = area.right - area.left, height = area.bottom - area.top, step = (width < height ? width : height) / 6;
    Py_ssize_t counts[256] = {0}, sampled = 0, seen = 0;
    step = step < 1 ? 1 : step;
    for (int i = area.top; i < area.bottom; i += step)
        for (int j = area.left; j < area.right; j += step) counts[light[i * stride + j]]++, sampled++;
    int dark = 0;
    while (seen + counts[dark] <= sampled / 2) seen += counts[dark++];
    double level = dark + levels;
    int limit = level >= 255 ? 255 : level >= 0 ? (int)level : -1;
    above = malloc((size_t)w * h);
    stack = malloc(sizeof(int32_t) * (size_t)w * h);
    if (!above || !stack) {
        PyErr_NoMemory();
        goto end;
    }
again:
    width = area.right - area.left, height = area.bottom - area.top;
    for (int i = 0; i < height; i++) {
        const uint8_t *row = light + (area.top + i) * stride + area.left;
        for (int j = 0; j < width; j++) above[i * width + j] = row[j] > limit;
    }
    found = PyList_New(0);
    if (!found) goto end;
    const uint8_t *next, *last = above + (size_t)width * height;
    for (next = above; (next = memchr(next, 1, last - next)); ) {
        Component c = component_of(above, width, height, stack, (int32_t)(next - above));
        if ((c.box.left == 0 && area.left > 0) || (c.box.top == 0 && area.top > 0)
            || (c.box.right == width && area.right < w) || (c.box.bottom == height && area.bottom < h)) {
            area = whole; /* cut off */
            Py_CLEAR(found);
            goto again;
        }
        if (c.pixels < min_area || c.pixels > max_area) continue;
        int64_t full = (int64_t)(c.box.right - c.box.left) * (c.box.bottom - c.box.top);
        int compact = 100 * c.pixels >= compact_percent * full;
        double x = area.left + (compact ? (c.box.left + c.box.right - 1) / 2.0 : (double)c.x / c.pixels);
        double y = area.top + (compact ? (c.box.top + c.box.bottom - 1) / 2.0 : (double)c.y / c.pixels);
        if (x < box.left - 1 || x >= box.right + 1 || y < box.top - 1 || y >= box.bottom + 1) continue;
        Box own = {area.left + c.box.left, area.top + c.box.top, area.left + c.box.right, area.top + c.box.bottom};
        Box window = window_of(own, w, h);
        width = area.right - area.left;
        int bw = own.right - own.left, bh = own.bottom - own.top;
        int crowded = bw <= max_led && bh <= max_led && bright_in(light, stride, window, w, h, limit) > c.pixels;
        PyObject *one = Py_BuildValue("((iiii)L(dd)(iiii)O)", own.left, own.top, bw, bh, (long long)c.pixels, x, y,
                                      window.left, window.top, window.right, window.bottom,
                                      crowded ? Py_True : Py_False);
        if (!one || PyList_Append(found, one) < 0) {
            Py_XDECREF(one);
            Py_CLEAR(found);
            goto end;
        }
        Py_DECREF(one);
    }
    found = Py_BuildValue("dN", level, found);
end:
    free(above), free(stack);
    PyBuffer_Release(&view);
    return found;
}

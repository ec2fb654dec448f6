/* Compiled kernel of the front end, the same numbers as those modules of coloc_graph/frontend, to rounding, that the
   comments name: they say what each step is for, and run where this is not built. docs/detection.md has the figures.

   Only the limited API is used, so that one binary serves CPython 3.11 and later. */

#ifndef COLOC_KERNEL_H
#define COLOC_KERNEL_H

#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct { double xx, xy, yy; } Symmetric;

PyObject *measure_spots(PyObject *module, PyObject *args);
PyObject *find_bright(PyObject *module, PyObject *args);
extern PyType_Spec filter_spec;

#endif

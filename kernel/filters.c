/* Kalman filters of points: tracks/kalman.py. */

#include "kernel.h"
#include <stddef.h>
#include <structmember.h>

typedef struct {
    PyObject_HEAD
    double u, v, du, dv, unseen;
    Symmetric p, w; /* covariances of position and velocity */
    double b[4];    /* cross covariance, row by row */
} PointFilter;

static PyObject *filter_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    double u, v, variance;
    Symmetric p;
    if (!PyArg_ParseTuple(args, "dd(ddd)d", &u, &v, &p.xx, &p.xy, &p.yy, &variance)) return NULL;
    PointFilter *f = (PointFilter *)((allocfunc)PyType_GetSlot(type, Py_tp_alloc))(type, 0);
    if (!f) return NULL;
    f->u = u, f->v = v, f->p = p, f->w = (Symmetric){variance, 0.0, variance};
    return (PyObject *)f;
}

static void filter_dealloc(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static PyObject *filter_p(PyObject *self, void *closure)
{
    const PointFilter *f = (PointFilter *)self;
    return Py_BuildValue("ddd", f->p.xx, f->p.xy, f->p.yy);
}

static PyObject *filter_b(PyObject *self, void *closure)
{
    const double *b = ((PointFilter *)self)->b;
    return Py_BuildValue("dddd", b[0], b[1], b[2], b[3]);
}

static PyObject *filter_w(PyObject *self, void *closure)
{
    const PointFilter *f = (PointFilter *)self;
    return Py_BuildValue("ddd", f->w.xx, f->w.xy, f->w.yy);
}

static PyObject *filter_predict(PyObject *self, PyObject *args)
{
    PointFilter *f = (PointFilter *)self;
    double dt, q, *b = f->b;
    if (!PyArg_ParseTuple(args, "dd", &dt, &q)) return NULL;
    f->unseen += dt, f->u += dt * f->du, f->v += dt * f->dv;
    double added = dt * dt * dt / 3 * q;
    f->p.xx += dt * (2 * b[0] + dt * f->w.xx) + added;
    f->p.xy += dt * (b[1] + b[2] + dt * f->w.xy);
    f->p.yy += dt * (2 * b[3] + dt * f->w.yy) + added;
    added = dt * dt / 2 * q;
    b[0] += dt * f->w.xx + added, b[1] += dt * f->w.xy, b[2] += dt * f->w.xy, b[3] += dt * f->w.yy + added;
    f->w.xx += q * dt, f->w.yy += q * dt;
    return Py_NewRef(Py_None);
}

static PyObject *filter_compare(PyObject *self, PyObject *args)
{
    const PointFilter *f = (PointFilter *)self;
    double u, v, jerk, gate;
    Symmetric c;
    if (!PyArg_ParseTuple(args, "dd(ddd)dd", &u, &v, &c.xx, &c.xy, &c.yy, &jerk, &gate)) return NULL;
    double dx = u - f->u, dy = v - f->v, xx = f->p.xx + c.xx, xy = f->p.xy + c.xy, yy = f->p.yy + c.yy;
    double shift = jerk * f->unseen * jerk * f->unseen, jerk_xx = xx + shift, jerk_yy = yy + shift;
    if (dx * dx >= gate * jerk_xx || dy * dy >= gate * jerk_yy) return Py_NewRef(Py_None);
    double jerked = (jerk_yy * dx * dx - 2 * xy * dx * dy + jerk_xx * dy * dy) / (jerk_xx * jerk_yy - xy * xy);
    if (!(jerked < gate)) return Py_NewRef(Py_None);
    double determinant = xx * yy - xy * xy;
    double squared = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant;
    double density = -log(2 * 3.14159265358979323846) - 0.5 * log(determinant) - 0.5 * squared;
    return Py_BuildValue("ddd", squared, density, jerked);
}

static PyObject *filter_allow_jerk(PyObject *self, PyObject *args)
{
    PointFilter *f = (PointFilter *)self;
    double jerk, dt = f->unseen;
    if (!PyArg_ParseTuple(args, "d", &jerk)) return NULL;
    double change = jerk * jerk;
    f->p.xx += dt * dt * change, f->p.yy += dt * dt * change;
    f->b[0] += dt * change, f->b[3] += dt * change;
    f->w.xx += change, f->w.yy += change;
    return Py_NewRef(Py_None);
}

static PyObject *filter_update(PyObject *self, PyObject *args)
{
    PointFilter *f = (PointFilter *)self;
    double u, v;
    Symmetric c, p = f->p;
    if (!PyArg_ParseTuple(args, "dd(ddd)", &u, &v, &c.xx, &c.xy, &c.yy)) return NULL;
    double xx = p.xx + c.xx, xy = p.xy + c.xy, yy = p.yy + c.yy, determinant = xx * yy - xy * xy;
    double ixx = yy / determinant, ixy = -xy / determinant, iyy = xx / determinant;
    double b0 = f->b[0], b1 = f->b[1], b2 = f->b[2], b3 = f->b[3], dx = u - f->u, dy = v - f->v;
    double k00 = p.xx * ixx + p.xy * ixy, k01 = p.xx * ixy + p.xy * iyy;
    double k10 = p.xy * ixx + p.yy * ixy, k11 = p.xy * ixy + p.yy * iyy;
    double g00 = b0 * ixx + b2 * ixy, g01 = b0 * ixy + b2 * iyy, g10 = b1 * ixx + b3 * ixy, g11 = b1 * ixy + b3 * iyy;
    f->u += k00 * dx + k01 * dy, f->v += k10 * dx + k11 * dy;
    f->du += g00 * dx + g01 * dy, f->dv += g10 * dx + g11 * dy;
    f->p = (Symmetric){k00 * c.xx + k01 * c.xy, k00 * c.xy + k01 * c.yy, k10 * c.xy + k11 * c.yy};
    f->w.xx -= g00 * b0 + g01 * b2, f->w.xy -= g00 * b1 + g01 * b3, f->w.yy -= g10 * b1 + g11 * b3;
    f->b[0] = b0 - k00 * b0 - k01 * b2, f->b[1] = b1 - k00 * b1 - k01 * b3;
    f->b[2] = b2 - k10 * b0 - k11 * b2, f->b[3] = b3 - k10 * b1 - k11 * b3;
    f->unseen = 0;
    return Py_NewRef(Py_None);
}

static PyMethodDef filter_methods[] = {
    {"predict", filter_predict, METH_VARARGS, NULL},
    {"compare", filter_compare, METH_VARARGS, NULL},
    {"allow_jerk", filter_allow_jerk, METH_VARARGS, NULL},
    {"update", filter_update, METH_VARARGS, NULL},
    {NULL},
};

static PyMemberDef filter_members[] = {
    {"u", T_DOUBLE, offsetof(PointFilter, u), READONLY, NULL},
    {"v", T_DOUBLE, offsetof(PointFilter, v), READONLY, NULL},
    {"du", T_DOUBLE, offsetof(PointFilter, du), READONLY, NULL},
    {"dv", T_DOUBLE, offsetof(PointFilter, dv), READONLY, NULL},
    {"unseen", T_DOUBLE, offsetof(PointFilter, unseen), READONLY, NULL},
    {NULL},
};

static PyGetSetDef filter_getters[] = {
    {"p", filter_p, NULL, NULL, NULL},
    {"b", filter_b, NULL, NULL, NULL},
    {"w", filter_w, NULL, NULL, NULL},
    {NULL},
};

static PyType_Slot filter_slots[] = {
    {Py_tp_new, filter_new},
    {Py_tp_dealloc, filter_dealloc},
    {Py_tp_methods, filter_methods},
    {Py_tp_members, filter_members},
    {Py_tp_getset, filter_getters},
    {0, NULL},
};

PyType_Spec filter_spec = {
    "coloc_graph.frontend._kernel.PointFilter", sizeof(PointFilter), 0, Py_TPFLAGS_DEFAULT, filter_slots,
};

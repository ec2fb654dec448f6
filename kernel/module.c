#include "kernel.h"

static int add_names(PyObject *module)
{
    PyObject *type = PyType_FromSpec(&filter_spec);
    int failed = !type || PyModule_AddObjectRef(module, "PointFilter", type) < 0
                 || PyModule_AddIntConstant(module, "VERSION", 2) < 0; /* with that of frontend/compiled.py */
    Py_XDECREF(type);
    return failed ? -1 : 0;
}

static PyMethodDef functions[] = {
    {"find_bright", find_bright, METH_VARARGS, NULL},
    {"measure_spots", measure_spots, METH_VARARGS, NULL},
    {NULL},
};

static PyModuleDef_Slot slots[] = {{Py_mod_exec, add_names}, {0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, .m_name = "_kernel", .m_doc = "Compiled kernel of the front end.", .m_size = 0,
    .m_methods = functions, .m_slots = slots,
};

PyMODINIT_FUNC PyInit__kernel(void) { return PyModuleDef_Init(&definition); }

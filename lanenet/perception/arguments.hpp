// Arguments from Python, as all compiled loops take them: contiguous buffers, whose types the Python code sees to.

#pragma once

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <cstddef>

// The memory of an argument; released at the end.
struct Buffer {
  Py_buffer view{};
  ~Buffer() { PyBuffer_Release(&view); }
  template <class T>
  const T* as() const {
    return static_cast<const T*>(view.buf);
  }
  // Of an argument that is written to.
  template <class T>
  T* into() const {
    return static_cast<T*>(view.buf);
  }
  template <class T>
  Py_ssize_t size() const {
    return view.len / Py_ssize_t{sizeof(T)};
  }
  template <class T>
  bool holds(std::size_t count) const {
    return static_cast<std::size_t>(view.len) == count * sizeof(T);
  }
};

inline PyObject* refuse(const char* what) {
  PyErr_SetString(PyExc_ValueError, what);
  return nullptr;
}

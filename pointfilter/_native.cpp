// Neighbourhoods, PCA frames and patches of a point cloud, one pass per point, with the GIL released.
//
// Everything here works on one contiguous range of centres in the calling thread; the Python side (patches.py) decides
// which range goes to which thread. No result depends on that split, on the number of threads or on the order of the
// input: the members of a ball are visited in the order of the index, which is sorted by (cell, x, y, z).
//
// Built against CPython's stable ABI: one binary serves every Python from 3.11 on.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace {

constexpr int64_t kMaxReach = 63;  // cells from a centre's cell to the farthest one of its ball; patches.EMPTY_CELLS is larger
constexpr double kSteps = 1 << 12;  // steps of a squared distance, in units of the radius, for the sampling keys
constexpr double kSlack = 1 + 1e-12;  // factor of a radius, so that rounding leaves no point at the border of its ball
constexpr double kGrowth = 1.5;     // of the search radius for the k-th neighbour
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int kJacobiSweeps = 12;  // three are typical, the loop leaves as soon as the matrix is diagonal

// ---------------------------------------------------------------------------------------------------------------
// The index: points sorted by cell, one entry a non-empty cell.

uint64_t mix(uint64_t value) {  // Stafford's variant 13 of the MurmurHash3 finaliser
  value ^= value >> 30;
  value *= 0xbf58476d1ce4e5b9ULL;
  value ^= value >> 27;
  value *= 0x94d049bb133111ebULL;
  return value ^ (value >> 31);
}

struct Index {
  const double* x;
  const double* y;
  const double* z;
  int64_t points;
  const int64_t* cell_keys;    // sorted, unique; key = (cz * ny + cy) * nx + cx
  const int64_t* cell_starts;  // one longer than cell_keys
  int64_t cells;
  double edge;
  int64_t shape[3];  // nx, ny, nz
};

struct Cell {
  int64_t start, end;
  double low[3], high[3];
};

// The points of a ball around a point of the index. Centres come sorted by cell, so the cells around one are looked up
// once a cell and not once a point.
class Neighbourhood {
 public:
  explicit Neighbourhood(const Index& index) : index_(index) {}

  // Positions (in the index) of points p with |p - centre| < radius; squared() holds their squared distances.
  // An empty answer (the centre is in every other one) stands for a radius beyond kMaxReach cells.
  std::vector<int64_t>& around(int64_t centre, double radius) {
    members_.clear();
    squared_.clear();
    if (!locate(centre, radius)) return members_;
    const double at[3] = {index_.x[centre], index_.y[centre], index_.z[centre]};
    const double limit = radius * radius;
    size_t found = 0;
    for (const Cell& cell : cells_) {
      double gap = 0;
      for (int axis = 0; axis < 3; ++axis) {
        const double value = at[axis];
        const double distance =
            value < cell.low[axis] ? cell.low[axis] - value : (value > cell.high[axis] ? value - cell.high[axis] : 0.0);
        gap += distance * distance;
      }
      if (gap >= limit * (1 + 1e-9)) continue;
      members_.resize(found + static_cast<size_t>(cell.end - cell.start));
      squared_.resize(members_.size());
      for (int64_t j = cell.start; j < cell.end; ++j) {
        const double x = index_.x[j] - at[0], y = index_.y[j] - at[1], z = index_.z[j] - at[2];
        const double distance = x * x + y * y + z * z;
        members_[found] = j;
        squared_[found] = distance;
        found += distance < limit;
      }
    }
    members_.resize(found);
    squared_.resize(found);
    return members_;
  }

  std::vector<double>& squared() { return squared_; }

 private:
  bool locate(int64_t centre, double radius) {
    const double cells = std::ceil(radius / index_.edge);
    if (!(cells <= static_cast<double>(kMaxReach))) return false;
    const int64_t reach = std::max<int64_t>(1, static_cast<int64_t>(cells));
    if (centre >= home_start_ && centre < home_end_ && reach == reach_) return true;
    const int64_t* starts = index_.cell_starts;
    const int64_t home = std::upper_bound(starts, starts + index_.cells + 1, centre) - starts - 1;
    home_start_ = starts[home];
    home_end_ = starts[home + 1];
    reach_ = reach;
    const int64_t key = index_.cell_keys[home];
    const int64_t at[3] = {key % index_.shape[0], key / index_.shape[0] % index_.shape[1],
                           key / (index_.shape[0] * index_.shape[1])};
    // Cells so close by have not been moved together (patches.py), so their true places follow from the centre's.
    const double origin[3] = {std::floor(index_.x[centre] / index_.edge), std::floor(index_.y[centre] / index_.edge),
                              std::floor(index_.z[centre] / index_.edge)};
    int64_t low[3], high[3];
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::max<int64_t>(at[axis] - reach, 0);
      high[axis] = std::min<int64_t>(at[axis] + reach, index_.shape[axis] - 1);
    }
    cells_.clear();
    const double slack = index_.edge * 1e-6;
    const int64_t* end = index_.cell_keys + index_.cells;
    for (int64_t cz = low[2]; cz <= high[2]; ++cz) {
      for (int64_t cy = low[1]; cy <= high[1]; ++cy) {
        const int64_t row = (cz * index_.shape[1] + cy) * index_.shape[0];
        const int64_t* found = std::lower_bound(index_.cell_keys, end, row + low[0]);
        for (; found != end && *found <= row + high[0]; ++found) {
          const int64_t position[3] = {*found - row, cy, cz};
          Cell cell;
          cell.start = starts[found - index_.cell_keys];
          cell.end = starts[found - index_.cell_keys + 1];
          for (int axis = 0; axis < 3; ++axis) {
            cell.low[axis] = index_.edge * (origin[axis] + static_cast<double>(position[axis] - at[axis])) - slack;
            cell.high[axis] = cell.low[axis] + index_.edge + 2 * slack;
          }
          cells_.push_back(cell);
        }
      }
    }
    return true;
  }

  const Index& index_;
  int64_t home_start_ = 0, home_end_ = 0;  // of the cell that cells_ are around
  int64_t reach_ = 0;
  std::vector<Cell> cells_;
  std::vector<int64_t> members_;
  std::vector<double> squared_;
};

// ---------------------------------------------------------------------------------------------------------------
// Keyed downsampling: a neighbour's key is a hash of its distance, which no motion of the cloud changes and which knows
// nothing of the rest of the cloud; the smallest `wanted` keys stay.

class Selection {
 public:
  // Keeps `wanted` of `members` in their order. The centre, whose distance is 0, always stays.
  void keep(std::vector<int64_t>& members, const std::vector<double>& squared, double radius, uint64_t key,
            size_t wanted) {
    const size_t count = members.size();
    keys_.resize(count);
    const double scale = kSteps / (radius * radius);
    const uint64_t base = mix(key);
    for (size_t k = 0; k < count; ++k) {
      const uint64_t step = static_cast<uint64_t>(squared[k] * scale);
      keys_[k] = squared[k] == 0 ? 0 : mix(base + step * 0x9e3779b97f4a7c15ULL);
    }
    sorted_ = keys_;
    const auto border = sorted_.begin() + static_cast<std::ptrdiff_t>(wanted - 1);
    std::nth_element(sorted_.begin(), border, sorted_.end());
    const uint64_t threshold = *border;
    equal_.clear();  // to the threshold: the nearest of them get the places that are left
    size_t below = 0;
    for (size_t k = 0; k < count; ++k) {
      below += keys_[k] < threshold;
      if (keys_[k] == threshold) equal_.push_back(k);
    }
    const auto last = equal_.begin() + static_cast<std::ptrdiff_t>(wanted - below);
    if (last != equal_.end()) {
      std::stable_sort(equal_.begin(), equal_.end(), [&](size_t p, size_t q) { return squared[p] < squared[q]; });
      for (auto k = last; k != equal_.end(); ++k) keys_[*k] = UINT64_MAX;
    }
    size_t kept = 0;
    for (size_t k = 0; k < count; ++k) {
      members[kept] = members[k];
      kept += keys_[k] <= threshold;
    }
    members.resize(wanted);
  }

 private:
  std::vector<uint64_t> keys_;
  std::vector<uint64_t> sorted_;
  std::vector<size_t> equal_;
};

// ---------------------------------------------------------------------------------------------------------------
// The PCA frame.

// Eigenvectors (columns of v) of a symmetric 3 x 3 matrix by cyclic Jacobi rotations; a is overwritten, its diagonal
// holds the eigenvalues.
void jacobi(double a[3][3], double v[3][3]) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) v[i][j] = i == j;
  for (int sweep = 0; sweep < kJacobiSweeps; ++sweep) {
    const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
    const double diagonal = a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2];
    if (off <= 1e-32 * diagonal) return;
    for (int p = 0; p < 2; ++p) {
      for (int q = p + 1; q < 3; ++q) {
        if (a[p][q] == 0.0) continue;
        const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const double t = (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < 3; ++k) {
          const double kp = a[k][p], kq = a[k][q];
          a[k][p] = c * kp - s * kq;
          a[k][q] = s * kp + c * kq;
        }
        for (int k = 0; k < 3; ++k) {
          const double pk = a[p][k], qk = a[q][k];
          a[p][k] = c * pk - s * qk;
          a[q][k] = s * pk + c * qk;
        }
        for (int k = 0; k < 3; ++k) {
          const double kp = v[k][p], kq = v[k][q];
          v[k][p] = c * kp - s * kq;
          v[k][q] = s * kp + c * kq;
        }
      }
    }
  }
}

// Rows of `frame`: x (second axis), y, z (least variance), right-handed. PCA leaves the signs of x and z free: both point
// to the side of the centre where the mean of the neighbours lies.
void pca_frame(const Index& index, const std::vector<int64_t>& members, const double* centre, double scale,
               double* frame) {
  double mean[3] = {}, second[6] = {};
  for (const int64_t j : members) {
    const double x = (index.x[j] - centre[0]) * scale;
    const double y = (index.y[j] - centre[1]) * scale;
    const double z = (index.z[j] - centre[2]) * scale;
    mean[0] += x, mean[1] += y, mean[2] += z;
    second[0] += x * x, second[1] += x * y, second[2] += x * z;
    second[3] += y * y, second[4] += y * z, second[5] += z * z;
  }
  const double count = static_cast<double>(members.size());
  for (double& value : mean) value /= count;
  for (double& value : second) value /= count;
  double a[3][3] = {{second[0] - mean[0] * mean[0], second[1] - mean[0] * mean[1], second[2] - mean[0] * mean[2]},
                    {0, second[3] - mean[1] * mean[1], second[4] - mean[1] * mean[2]},
                    {0, 0, second[5] - mean[2] * mean[2]}};
  a[1][0] = a[0][1], a[2][0] = a[0][2], a[2][1] = a[1][2];
  double v[3][3];
  jacobi(a, v);
  int order[3] = {0, 1, 2};
  std::stable_sort(order, order + 3, [&](int p, int q) { return a[p][p] > a[q][q]; });
  double* x = frame;
  double* y = frame + 3;
  double* z = frame + 6;
  for (int k = 0; k < 3; ++k) x[k] = v[k][order[1]], z[k] = v[k][order[2]];
  for (double* axis : {x, z}) {
    if (axis[0] * mean[0] + axis[1] * mean[1] + axis[2] * mean[2] < 0)
      for (int k = 0; k < 3; ++k) axis[k] = -axis[k];
  }
  y[0] = z[1] * x[2] - z[2] * x[1];
  y[1] = z[2] * x[0] - z[0] * x[2];
  y[2] = z[0] * x[1] - z[1] * x[0];
}

// ---------------------------------------------------------------------------------------------------------------
// What Python calls. Shapes and dtypes are patches.py's business; here the lengths of all buffers are checked against
// each other, and the arrays of the index against their ranges.

struct Buffer {
  Py_buffer view{};
  bool held = false;
  ~Buffer() {
    if (held) PyBuffer_Release(&view);
  }
  bool take(PyObject* object, Py_ssize_t item, bool writable, const char* name) {
    const int flags = PyBUF_C_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(object, &view, flags) != 0) return false;
    held = true;
    if (view.itemsize != item && view.len != 0) {
      PyErr_Format(PyExc_TypeError, "%s: items of %zd bytes, expected %zd", name, view.itemsize, item);
      return false;
    }
    return true;
  }
  template <class T>
  T* data() const {
    return static_cast<T*>(view.buf);
  }
  Py_ssize_t items() const { return view.itemsize ? view.len / view.itemsize : 0; }
};

bool expect(const Buffer& buffer, Py_ssize_t items, const char* name) {
  if (buffer.items() == items) return true;
  PyErr_Format(PyExc_ValueError, "%s: %zd items, expected %zd", name, buffer.items(), items);
  return false;
}

struct IndexBuffers {
  Buffer points, keys, starts, edge, shape;
  Index index{};

  // A tuple (points (3, n) f8, cell_keys (m,) i8, cell_starts (m + 1,) i8, edge (1,) f8, shape (3,) i8).
  bool take(PyObject* tuple) {
    PyObject* object[5];
    if (!PyArg_ParseTuple(tuple, "OOOOO", &object[0], &object[1], &object[2], &object[3], &object[4])) return false;
    if (!points.take(object[0], 8, false, "points") || !keys.take(object[1], 8, false, "cell_keys") ||
        !starts.take(object[2], 8, false, "cell_starts") || !edge.take(object[3], 8, false, "edge") ||
        !shape.take(object[4], 8, false, "shape"))
      return false;
    const Py_ssize_t n = points.items() / 3, m = keys.items();
    if (!expect(points, 3 * n, "points") || !expect(starts, m + 1, "cell_starts") || !expect(edge, 1, "edge") ||
        !expect(shape, 3, "shape"))
      return false;
    const double* p = points.data<double>();
    const int64_t* s = shape.data<int64_t>();
    index = Index{p,    p + n, p + 2 * n, n, keys.data<int64_t>(), starts.data<int64_t>(), m, edge.data<double>()[0],
                  {s[0], s[1], s[2]}};
    bool sound = index.edge > 0 && s[0] > 0 && s[1] > 0 && s[2] > 0 && index.cell_starts[0] == 0 &&
                 index.cell_starts[m] == n;
    for (Py_ssize_t cell = 0; sound && cell < m; ++cell) sound = index.cell_starts[cell] < index.cell_starts[cell + 1];
    if (!sound) PyErr_SetString(PyExc_ValueError, "the index does not fit its points");
    return sound;
  }
};

// Positions (q,) i8 of centres in the index, and a radius for each.
struct Centres {
  Buffer positions, radii;
  bool take(PyObject* positions_object, PyObject* radii_object, const Index& index) {
    if (!positions.take(positions_object, 8, false, "positions") || !radii.take(radii_object, 8, false, "radii") ||
        !expect(radii, positions.items(), "radii"))
      return false;
    for (Py_ssize_t i = 0; i < positions.items(); ++i) {
      if (positions.data<int64_t>()[i] < 0 || positions.data<int64_t>()[i] >= index.points) {
        PyErr_SetString(PyExc_ValueError, "positions beyond the index");
        return false;
      }
    }
    return true;
  }
  Py_ssize_t count() const { return positions.items(); }
  int64_t position(Py_ssize_t i) const { return positions.data<int64_t>()[i]; }
  double radius(Py_ssize_t i) const { return radii.data<double>()[i]; }
};

bool out_of_memory() {
  PyErr_NoMemory();
  return false;
}

// Runs work(i) for every centre without the GIL.
template <class Work>
bool for_each(Py_ssize_t count, Work&& work) {
  bool failed = false;
  PyThreadState* state = PyEval_SaveThread();
  try {
    for (Py_ssize_t i = 0; i < count; ++i) work(i);
  } catch (const std::bad_alloc&) {
    failed = true;
  }
  PyEval_RestoreThread(state);
  return failed ? out_of_memory() : true;
}

PyObject* build_patches(PyObject*, PyObject* args) {
  PyObject *index_object, *positions_object, *radii_object, *patches_object, *frames_object, *counts_object;
  unsigned long long key;
  if (!PyArg_ParseTuple(args, "OOOKOOO", &index_object, &positions_object, &radii_object, &key, &patches_object,
                        &frames_object, &counts_object))
    return nullptr;
  IndexBuffers held;
  Centres centres;
  Buffer patches, frames, counts;
  if (!held.take(index_object) || !centres.take(positions_object, radii_object, held.index) ||
      !patches.take(patches_object, 4, true, "patches") || !frames.take(frames_object, 8, true, "frames") ||
      !counts.take(counts_object, 8, true, "counts"))
    return nullptr;
  const Index& index = held.index;
  const Py_ssize_t n = centres.count();
  const Py_ssize_t length = n ? patches.items() / (3 * n) : 0;
  if (!expect(frames, 9 * n, "frames") || !expect(counts, n, "counts") ||
      !expect(patches, 3 * n * length, "patches"))
    return nullptr;
  Neighbourhood neighbourhood(index);
  Selection selection;
  const bool done = for_each(length ? n : 0, [&](Py_ssize_t i) {
    const int64_t at = centres.position(i);
    const double centre[3] = {index.x[at], index.y[at], index.z[at]};
    const double scale = 1 / centres.radius(i);
    double* frame = frames.data<double>() + 9 * i;
    float* patch = patches.data<float>() + 3 * length * i;
    std::vector<int64_t>& members = neighbourhood.around(at, centres.radius(i));
    counts.data<int64_t>()[i] = static_cast<int64_t>(members.size());
    if (members.empty()) {
      for (int k = 0; k < 9; ++k) frame[k] = k % 4 == 0;
      std::fill(patch, patch + 3 * length, 0.0f);
      return;
    }
    pca_frame(index, members, centre, scale, frame);
    if (static_cast<Py_ssize_t>(members.size()) > length)
      selection.keep(members, neighbourhood.squared(), centres.radius(i), key, static_cast<size_t>(length));
    for (size_t k = 0; k < members.size(); ++k) {
      const double x = (index.x[members[k]] - centre[0]) * scale;
      const double y = (index.y[members[k]] - centre[1]) * scale;
      const double z = (index.z[members[k]] - centre[2]) * scale;
      for (int row = 0; row < 3; ++row)
        patch[3 * k + static_cast<size_t>(row)] =
            static_cast<float>(frame[3 * row] * x + frame[3 * row + 1] * y + frame[3 * row + 2] * z);
    }
    std::fill(patch + 3 * members.size(), patch + 3 * length, 0.0f);
  });
  if (!done) return nullptr;
  Py_RETURN_NONE;
}

PyObject* ball_radii(PyObject*, PyObject* args) {
  PyObject *index_object, *positions_object, *guesses_object, *sizes_object, *radii_object;
  if (!PyArg_ParseTuple(args, "OOOOO", &index_object, &positions_object, &guesses_object, &sizes_object,
                        &radii_object))
    return nullptr;
  IndexBuffers held;
  Centres centres;
  Buffer sizes, radii;
  if (!held.take(index_object) || !centres.take(positions_object, guesses_object, held.index) ||
      !sizes.take(sizes_object, 8, false, "sizes") || !radii.take(radii_object, 8, true, "radii"))
    return nullptr;
  const Py_ssize_t n = centres.count();
  const Py_ssize_t each = n ? sizes.items() / n : 0;
  if (!expect(sizes, n * each, "sizes") || !expect(radii, n * each, "radii")) return nullptr;
  Neighbourhood neighbourhood(held.index);
  const bool done = for_each(n, [&](Py_ssize_t i) {
    const int64_t* wanted = sizes.data<int64_t>() + i * each;
    double* out = radii.data<double>() + i * each;
    const int64_t most = each ? *std::max_element(wanted, wanted + each) : 0;
    std::fill(out, out + each, kInfinity);
    double radius = centres.radius(i);
    std::vector<double>& squared = neighbourhood.squared();
    while (!neighbourhood.around(centres.position(i), radius).empty()) {
      const int64_t found = static_cast<int64_t>(squared.size());
      if (found > most || found == held.index.points) break;
      radius *= kGrowth;
    }
    if (squared.empty()) {  // the last ball was too large for the grid: the one before it
      neighbourhood.around(centres.position(i), radius / kGrowth);
    }
    std::sort(squared.begin(), squared.end());
    for (Py_ssize_t k = 0; k < each; ++k)
      if (wanted[k] > 0 && wanted[k] < static_cast<int64_t>(squared.size())) {
        const size_t next = static_cast<size_t>(wanted[k]);  // between the last point of the ball and the next one
        out[k] = std::sqrt((squared[next - 1] + squared[next]) / 2) * kSlack;
      }
  });
  if (!done) return nullptr;
  Py_RETURN_NONE;
}

PyObject* smallest_key(PyObject*, PyObject* args) {
  PyObject *index_object, *positions_object, *radii_object, *keys_object, *owners_object;
  if (!PyArg_ParseTuple(args, "OOOOO", &index_object, &positions_object, &radii_object, &keys_object, &owners_object))
    return nullptr;
  IndexBuffers held;
  Centres centres;
  Buffer keys, owners;
  if (!held.take(index_object) || !centres.take(positions_object, radii_object, held.index) ||
      !keys.take(keys_object, 8, false, "keys") || !owners.take(owners_object, 8, true, "owners") ||
      !expect(keys, static_cast<Py_ssize_t>(held.index.points), "keys") || !expect(owners, centres.count(), "owners"))
    return nullptr;
  Neighbourhood neighbourhood(held.index);
  const uint64_t* key = keys.data<uint64_t>();
  const bool done = for_each(centres.count(), [&](Py_ssize_t i) {
    int64_t owner = centres.position(i);
    for (const int64_t j : neighbourhood.around(owner, centres.radius(i)))
      if (key[j] < key[owner]) owner = j;
    owners.data<int64_t>()[i] = owner;
  });
  if (!done) return nullptr;
  Py_RETURN_NONE;
}

PyMethodDef methods[] = {
    {"build_patches", build_patches, METH_VARARGS,
     "build_patches(index, positions (q,) i8, radii (q,) f8, key, patches (q, N, 3) f4 out, frames (q, 3, 3) f8 out, "
     "counts (q,) i8 out)"},
    {"ball_radii", ball_radii, METH_VARARGS,
     "ball_radii(index, positions (q,) i8, guesses (q,) f8, sizes (q, L) i8, radii (q, L) f8 out)"},
    {"smallest_key", smallest_key, METH_VARARGS,
     "smallest_key(index, positions (q,) i8, radii (q,) f8, keys (n,) u8, owners (q,) i8 out)"},
    {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {PyModuleDef_HEAD_INIT, "_native", "Compiled part of pointfilter.patches.", 0, methods,
                      nullptr,               nullptr,   nullptr,                                 nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__native() { return PyModule_Create(&module); }

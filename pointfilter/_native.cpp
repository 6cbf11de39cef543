// Neighbourhoods, PCA frames and patches of a point cloud, one pass per point, with the GIL released.
//
// Everything here works on one contiguous range of centres in the calling thread; the Python side (patches.py) decides
// who works on which range. No result depends on that split, on the number of threads or on the order of the input: the
// candidates of a centre are visited in the order of the index, and the index is sorted by (cell, stable id).
//
// Built against CPython's stable ABI: one binary serves every Python from 3.11 on.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

namespace {

constexpr int kKeyBins = 256;      // first digit of the selection by key
constexpr int kHighestLevel = 40;  // of thinning: one point in 2^40
constexpr size_t kEnough = 1024;   // points of a ball that are looked at, at least, or four times a patch's length
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int kJacobiSweeps = 12;  // three are typical, the loop leaves as soon as the matrix is diagonal

// ---------------------------------------------------------------------------------------------------------------
// The index: points sorted by (cell, mix(id)), one entry a non-empty cell.

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
  const uint64_t* ids;
  int64_t points;
  const int64_t* cell_keys;    // sorted, unique; key = (cz * ny + cy) * nx + cx
  const int64_t* cell_starts;  // one longer than cell_keys
  int64_t cells;
  double origin[3];
  double edge;
  int64_t shape[3];  // nx, ny, nz

  // The first position in [start, stop), which lie in one cell, whose mixed id is not below `limit`.
  int64_t not_below(uint64_t limit, int64_t start, int64_t stop) const {
    while (start < stop) {
      const int64_t middle = start + (stop - start) / 2;
      if (mix(ids[middle]) < limit)
        start = middle + 1;
      else
        stop = middle;
    }
    return start;
  }
};

struct Cell {
  int64_t start, end;
  int64_t stop;  // where the points of the level end
  double low[3], high[3];
};

// What is close to a centre. Centres come sorted by cell, so the cells are looked up once a cell and not once a point.
//
// Dense clouds are thinned: level k holds the points whose mixed id starts with k zero bits, about one in 2^k, and a
// ball gets the highest level that has `enough` points in it. The levels are those of the cloud, so neither the centre's
// cell nor the cloud's pose has a say in the choice.
class Neighbourhood {
 public:
  Neighbourhood(const Index& index, double radius) : index_(index), radius_(radius) {}

  // Positions (in the index) of points p with |p - centre| < radius: all of them, or of those levels that are needed
  // for `enough`.
  std::vector<int64_t>& around(const double* centre, size_t enough) {
    locate(centre);
    if (fresh_) guess(enough);
    gather(centre, SIZE_MAX);
    while (level_ > 0 && members_.size() < enough) {
      set_level(level_ - 1);
      gather(centre, SIZE_MAX);
    }
    if (members_.size() >= enough) rise(enough);
    return members_;
  }

  // The same with the point of this id, if it lies in the centre's cell, among them in any case.
  std::vector<int64_t>& around(const double* centre, size_t enough, uint64_t id) {
    around(centre, enough);
    if (level_ == 0 || home_ == cells_.size() || mix(id) < limit(level_)) return members_;
    const Cell& home = cells_[home_];
    const int64_t j = index_.not_below(mix(id), home.start, home.end);
    if (j < home.end && index_.ids[j] == id && near(centre, j)) members_.push_back(j);
    return members_;
  }

  // How many points lie closer than the radius; stops counting at `enough`.
  size_t count(const double* centre, size_t enough) {
    locate(centre);
    set_level(0);
    gather(centre, enough);
    return std::min(members_.size(), enough);
  }

 private:
  static double gap(double value, double low, double high) {
    return value < low ? low - value : (value > high ? value - high : 0.0);
  }

  // Mixed ids of a level above 0 are below it.
  static uint64_t limit(int level) { return uint64_t{1} << (64 - level); }

  bool near(const double* centre, int64_t j) const {
    const double x = index_.x[j] - centre[0], y = index_.y[j] - centre[1], z = index_.z[j] - centre[2];
    return x * x + y * y + z * z < radius_ * radius_;
  }

  int64_t cell_of(double value, int axis) const {
    const double cell = std::floor((value - index_.origin[axis]) / index_.edge);
    const double last = static_cast<double>(index_.shape[axis] - 1);
    return static_cast<int64_t>(std::min(std::max(cell, 0.0), last));
  }

  void gather(const double* centre, size_t enough) {
    members_.clear();
    const double limit = radius_ * radius_;
    for (const Cell& cell : cells_) {
      double squared = 0;
      for (int axis = 0; axis < 3; ++axis) {
        const double distance = gap(centre[axis], cell.low[axis], cell.high[axis]);
        squared += distance * distance;
      }
      if (squared >= limit * (1 + 1e-9)) continue;
      const size_t before = members_.size();
      members_.resize(before + static_cast<size_t>(cell.stop - cell.start));
      int64_t* out = members_.data() + before;
      size_t found = 0;
      for (int64_t j = cell.start; j < cell.stop; ++j) {
        const double x = index_.x[j] - centre[0], y = index_.y[j] - centre[1], z = index_.z[j] - centre[2];
        out[found] = j;
        found += (x * x + y * y + z * z < limit);
      }
      members_.resize(before + found);
      if (members_.size() >= enough) return;
    }
  }

  // A level that is not too high to begin with: a ball fills more than a sixth of its cells, mostly.
  void guess(size_t enough) {
    fresh_ = false;
    int64_t total = 0;
    for (const Cell& cell : cells_) total += cell.end - cell.start;
    int level = 0;
    while (level < kHighestLevel && static_cast<size_t>(total >> level) > 6 * enough) ++level;
    set_level(level);
  }

  // Goes up to the highest level that still has `enough` of the members.
  void rise(size_t enough) {
    size_t at[65] = {};
    zeros_.resize(members_.size());
    for (size_t k = 0; k < members_.size(); ++k) {
      zeros_[k] = leading_zeros(mix(index_.ids[members_[k]]));
      ++at[zeros_[k]];
    }
    int level = 64;
    for (size_t total = at[64]; total < enough;) total += at[--level];
    level = std::min(level, kHighestLevel);
    if (level <= level_) return;
    size_t kept = 0;
    for (size_t k = 0; k < members_.size(); ++k)
      if (zeros_[k] >= level) members_[kept++] = members_[k];
    members_.resize(kept);
    set_level(level);
  }

  static uint8_t leading_zeros(uint64_t value) {
    uint8_t zeros = 0;
    while (zeros < 64 && !(value >> 63)) value <<= 1, ++zeros;
    return zeros;
  }

  void set_level(int level) {
    if (level == level_) return;
    level_ = level;
    for (Cell& cell : cells_) set_stop(cell);
  }

  void set_stop(Cell& cell) const {
    cell.stop = level_ == 0 ? cell.end : index_.not_below(limit(level_), cell.start, cell.end);
  }

  void locate(const double* centre) {
    std::array<int64_t, 6> box;  // the cells that the ball around any point of the centre's cell touches
    std::array<int64_t, 3> home;
    bool inside = true;
    for (size_t axis = 0; axis < 3; ++axis) {
      const int along = static_cast<int>(axis);
      const bool outside = centre[axis] < index_.origin[axis] ||
                           centre[axis] > index_.origin[axis] + index_.edge * static_cast<double>(index_.shape[axis]);
      home[axis] = cell_of(centre[axis], along);
      if (outside) {
        inside = false;
        box[axis] = cell_of(centre[axis] - radius_, along);
        box[axis + 3] = cell_of(centre[axis] + radius_, along);
      } else {
        const int64_t reach = static_cast<int64_t>(std::ceil(radius_ / index_.edge));
        box[axis] = std::max<int64_t>(home[axis] - reach, 0);
        box[axis + 3] = std::min<int64_t>(home[axis] + reach, index_.shape[axis] - 1);
      }
    }
    if (valid_ && box == box_ && home == home_cell_) return;
    box_ = box;
    home_cell_ = home;
    valid_ = true;
    cells_.clear();
    const int64_t home_key = inside ? (home[2] * index_.shape[1] + home[1]) * index_.shape[0] + home[0] : -1;
    size_t home_at = SIZE_MAX;
    const double slack = index_.edge * 1e-6;
    for (int64_t cz = box[2]; cz <= box[5]; ++cz) {
      for (int64_t cy = box[1]; cy <= box[4]; ++cy) {
        const int64_t row = (cz * index_.shape[1] + cy) * index_.shape[0];
        const int64_t* end = index_.cell_keys + index_.cells;
        const int64_t* key = std::lower_bound(index_.cell_keys, end, row + box[0]);
        for (; key != end && *key <= row + box[3]; ++key) {
          const int64_t position[3] = {*key - row, cy, cz};
          Cell cell;
          cell.start = index_.cell_starts[key - index_.cell_keys];
          cell.end = index_.cell_starts[key - index_.cell_keys + 1];
          for (int axis = 0; axis < 3; ++axis) {
            cell.low[axis] = index_.origin[axis] + index_.edge * static_cast<double>(position[axis]) - slack;
            cell.high[axis] = cell.low[axis] + index_.edge + 2 * slack;
            if (position[axis] == 0) cell.low[axis] = -kInfinity;  // what lies beyond the grid is in its outermost cells
            if (position[axis] == index_.shape[axis] - 1) cell.high[axis] = kInfinity;
          }
          set_stop(cell);
          if (*key == home_key) home_at = cells_.size();
          cells_.push_back(cell);
        }
      }
    }
    home_ = std::min(home_at, cells_.size());
  }

  const Index& index_;
  double radius_;
  int level_ = 0;
  bool fresh_ = true;
  bool valid_ = false;
  std::array<int64_t, 6> box_{};
  std::array<int64_t, 3> home_cell_{};
  std::vector<Cell> cells_;
  size_t home_ = 0;  // the centre's own among them; their number where it is none of them
  std::vector<int64_t> members_;
  std::vector<uint8_t> zeros_;
};

// ---------------------------------------------------------------------------------------------------------------
// Keyed downsampling: every (centre, neighbour) pair has a 64-bit key, the smallest `wanted` keys stay.

class Selection {
 public:
  // Keeps `wanted` of `members` in their order; the centre itself, when it is a member, always stays.
  void keep(std::vector<int64_t>& members, const uint64_t* ids, uint64_t centre_id, uint64_t key, size_t wanted) {
    const size_t count = members.size();
    keys_.resize(count);
    const uint64_t base = mix(key ^ mix(centre_id + 0x9e3779b97f4a7c15ULL));
    uint32_t bins[kKeyBins] = {};
    uint64_t copies = 0;  // points at the same place share an id and follow one another: number them
    for (size_t k = 0; k < count; ++k) {
      const uint64_t id = ids[members[k]];
      copies = k > 0 && id == ids[members[k - 1]] ? copies + 1 : 0;
      const uint64_t hashed = mix(base + id * 0x9e3779b97f4a7c15ULL + copies * 0xd1b54a32d192ed03ULL);
      const uint64_t value = id == centre_id && copies == 0 ? 0 : hashed;
      keys_[k] = value;
      ++bins[value >> 56];
    }
    size_t below = 0;
    size_t bin = 0;
    while (below + bins[bin] < wanted) below += bins[bin++];
    border_.clear();
    for (size_t k = 0; k < count; ++k)
      if (keys_[k] >> 56 == bin) border_.push_back(keys_[k]);
    const size_t rank = wanted - below - 1;
    std::nth_element(border_.begin(), border_.begin() + static_cast<std::ptrdiff_t>(rank), border_.end());
    const uint64_t threshold = border_[rank];
    size_t fitting = 0;
    for (size_t k = 0; k < count; ++k) fitting += keys_[k] <= threshold;
    size_t surplus = fitting - wanted;  // equal keys are next to impossible: leave out the last ones
    for (size_t k = count; surplus > 0 && k-- > 0;)
      if (keys_[k] == threshold) keys_[k] = UINT64_MAX, --surplus;
    size_t kept = 0;
    for (size_t k = 0; k < count; ++k) {  // without a branch that nobody could predict
      members[kept] = members[k];
      kept += keys_[k] <= threshold;
    }
    members.resize(wanted);
  }

 private:
  std::vector<uint64_t> keys_;
  std::vector<uint64_t> border_;
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
// each other. The order of the cells is taken on trust: NeighbourIndex is the only one who makes an index.

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
  Buffer points, ids, keys, starts, grid, shape;
  Index index{};

  // A tuple (points (3, n) f8, ids (n,) u8, cell_keys (m,) i8, cell_starts (m + 1,) i8, grid (4,) f8, shape (3,) i8).
  bool take(PyObject* tuple) {
    PyObject* object[6];
    if (!PyArg_ParseTuple(tuple, "OOOOOO", &object[0], &object[1], &object[2], &object[3], &object[4], &object[5]))
      return false;
    if (!points.take(object[0], 8, false, "points") || !ids.take(object[1], 8, false, "ids") ||
        !keys.take(object[2], 8, false, "cell_keys") || !starts.take(object[3], 8, false, "cell_starts") ||
        !grid.take(object[4], 8, false, "grid") || !shape.take(object[5], 8, false, "shape"))
      return false;
    const Py_ssize_t n = ids.items(), m = keys.items();
    if (!expect(points, 3 * n, "points") || !expect(starts, m + 1, "cell_starts") || !expect(grid, 4, "grid") ||
        !expect(shape, 3, "shape"))
      return false;
    const double* p = points.data<double>();
    const double* g = grid.data<double>();
    const int64_t* s = shape.data<int64_t>();
    index = Index{p,
                  p + n,
                  p + 2 * n,
                  ids.data<uint64_t>(),
                  n,
                  keys.data<int64_t>(),
                  starts.data<int64_t>(),
                  m,
                  {g[0], g[1], g[2]},
                  g[3],
                  {s[0], s[1], s[2]}};
    if (index.cell_starts[m] != n || index.edge <= 0) {
      PyErr_SetString(PyExc_ValueError, "the index does not fit its points");
      return false;
    }
    return true;
  }
};

// Members of a ball that are enough for a patch of this length.
size_t enough_for(Py_ssize_t length) { return std::max(kEnough, 4 * static_cast<size_t>(length)); }

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

PyObject* count_neighbours(PyObject*, PyObject* args) {
  PyObject *index_object, *centres_object, *counts_object;
  double radius;
  Py_ssize_t enough;
  if (!PyArg_ParseTuple(args, "OOdnO", &index_object, &centres_object, &radius, &enough, &counts_object))
    return nullptr;
  IndexBuffers held;
  Buffer centres, counts;
  if (!held.take(index_object) || !centres.take(centres_object, 8, false, "centres") ||
      !counts.take(counts_object, 8, true, "counts") || !expect(centres, 3 * counts.items(), "centres"))
    return nullptr;
  Neighbourhood neighbourhood(held.index, radius);
  const bool done = for_each(counts.items(), [&](Py_ssize_t i) {
    counts.data<int64_t>()[i] = static_cast<int64_t>(
        neighbourhood.count(centres.data<double>() + 3 * i, static_cast<size_t>(std::max<Py_ssize_t>(enough, 0))));
  });
  if (!done) return nullptr;
  Py_RETURN_NONE;
}

PyObject* sample_neighbours(PyObject*, PyObject* args) {
  PyObject *index_object, *centres_object, *centre_ids_object, *indices_object, *counts_object;
  double radius;
  unsigned long long key;
  if (!PyArg_ParseTuple(args, "OOOdKOO", &index_object, &centres_object, &centre_ids_object, &radius, &key,
                        &indices_object, &counts_object))
    return nullptr;
  IndexBuffers held;
  Buffer centres, centre_ids, indices, counts;
  if (!held.take(index_object) || !centres.take(centres_object, 8, false, "centres") ||
      !centre_ids.take(centre_ids_object, 8, false, "centre_ids") ||
      !indices.take(indices_object, 8, true, "indices") || !counts.take(counts_object, 8, true, "counts"))
    return nullptr;
  const Py_ssize_t n = counts.items();
  const Py_ssize_t length = n ? indices.items() / n : 0;
  if (!expect(centres, 3 * n, "centres") || !expect(centre_ids, n, "centre_ids") ||
      !expect(indices, n * length, "indices"))
    return nullptr;
  Neighbourhood neighbourhood(held.index, radius);
  Selection selection;
  const bool done = for_each(length ? n : 0, [&](Py_ssize_t i) {
    std::vector<int64_t>& members = neighbourhood.around(centres.data<double>() + 3 * i, enough_for(length));
    counts.data<int64_t>()[i] = static_cast<int64_t>(members.size());
    if (static_cast<Py_ssize_t>(members.size()) > length)
      selection.keep(members, held.index.ids, centre_ids.data<uint64_t>()[i], key, static_cast<size_t>(length));
    int64_t* row = indices.data<int64_t>() + i * length;
    std::copy(members.begin(), members.end(), row);
    std::fill(row + members.size(), row + length, int64_t{-1});
  });
  if (!done) return nullptr;
  Py_RETURN_NONE;
}

PyObject* build_patches(PyObject*, PyObject* args) {
  PyObject *index_object, *centres_object, *centre_ids_object, *patches_object, *frames_object, *counts_object;
  double radius;
  unsigned long long key;
  if (!PyArg_ParseTuple(args, "OOOdKOOO", &index_object, &centres_object, &centre_ids_object, &radius, &key,
                        &patches_object, &frames_object, &counts_object))
    return nullptr;
  IndexBuffers held;
  Buffer centres, centre_ids, patches, frames, counts;
  if (!held.take(index_object) || !centres.take(centres_object, 8, false, "centres") ||
      !centre_ids.take(centre_ids_object, 8, false, "centre_ids") ||
      !patches.take(patches_object, 4, true, "patches") || !frames.take(frames_object, 8, true, "frames") ||
      !counts.take(counts_object, 8, true, "counts"))
    return nullptr;
  const Py_ssize_t n = counts.items();
  const Py_ssize_t length = n ? patches.items() / (3 * n) : 0;
  if (!expect(centres, 3 * n, "centres") || !expect(centre_ids, n, "centre_ids") || !expect(frames, 9 * n, "frames") ||
      !expect(patches, 3 * n * length, "patches"))
    return nullptr;
  const Index& index = held.index;
  Neighbourhood neighbourhood(index, radius);
  Selection selection;
  const double scale = 1 / radius;
  const bool done = for_each(length ? n : 0, [&](Py_ssize_t i) {
    const double* centre = centres.data<double>() + 3 * i;
    const uint64_t id = centre_ids.data<uint64_t>()[i];
    double* frame = frames.data<double>() + 9 * i;
    float* patch = patches.data<float>() + 3 * length * i;
    std::vector<int64_t>& members = neighbourhood.around(centre, enough_for(length), id);
    counts.data<int64_t>()[i] = static_cast<int64_t>(members.size());
    if (members.empty()) {
      for (int k = 0; k < 9; ++k) frame[k] = k % 4 == 0;
      std::fill(patch, patch + 3 * length, 0.0f);
      return;
    }
    pca_frame(index, members, centre, scale, frame);
    if (static_cast<Py_ssize_t>(members.size()) > length)
      selection.keep(members, index.ids, id, key, static_cast<size_t>(length));
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

PyObject* mean_vectors(PyObject*, PyObject* args) {
  PyObject *index_object, *vectors_object, *means_object, *squares_object, *counts_object;
  double radius;
  Py_ssize_t first, enough;
  if (!PyArg_ParseTuple(args, "OOndnOOO", &index_object, &vectors_object, &first, &radius, &enough, &means_object,
                        &squares_object, &counts_object))
    return nullptr;
  IndexBuffers held;
  Buffer vectors, means, squares, counts;
  if (!held.take(index_object) || !vectors.take(vectors_object, 8, false, "vectors") ||
      !means.take(means_object, 8, true, "means") || !squares.take(squares_object, 8, true, "squares") ||
      !counts.take(counts_object, 8, true, "counts"))
    return nullptr;
  const Index& index = held.index;
  const Py_ssize_t n = counts.items();
  if (!expect(vectors, 3 * static_cast<Py_ssize_t>(index.points), "vectors") || !expect(means, 3 * n, "means") ||
      !expect(squares, n, "squares"))
    return nullptr;
  if (first < 0 || first > static_cast<Py_ssize_t>(index.points) - n) {
    PyErr_SetString(PyExc_ValueError, "positions beyond the index");
    return nullptr;
  }
  Neighbourhood neighbourhood(index, radius);
  const double* all = vectors.data<double>();
  const bool done = for_each(n, [&](Py_ssize_t i) {
    const Py_ssize_t at = first + i;
    const double centre[3] = {index.x[at], index.y[at], index.z[at]};
    double sum[3] = {}, square = 0;
    const std::vector<int64_t>& members =
        neighbourhood.around(centre, static_cast<size_t>(std::max<Py_ssize_t>(enough, 1)));
    for (const int64_t j : members) {
      const double* vector = all + 3 * j;
      for (int k = 0; k < 3; ++k) sum[k] += vector[k], square += vector[k] * vector[k];
    }
    const double count = static_cast<double>(std::max<size_t>(members.size(), 1));
    for (int k = 0; k < 3; ++k) means.data<double>()[3 * i + k] = sum[k] / count;
    squares.data<double>()[i] = square / count;
    counts.data<int64_t>()[i] = static_cast<int64_t>(members.size());
  });
  if (!done) return nullptr;
  Py_RETURN_NONE;
}

PyMethodDef methods[] = {
    {"count_neighbours", count_neighbours, METH_VARARGS,
     "count_neighbours(index, centres (q, 3) f8, radius, enough, counts (q,) i8 out)"},
    {"sample_neighbours", sample_neighbours, METH_VARARGS,
     "sample_neighbours(index, centres (q, 3) f8, centre_ids (q,) u8, radius, key, indices (q, N) i8 out, "
     "counts (q,) i8 out)"},
    {"build_patches", build_patches, METH_VARARGS,
     "build_patches(index, centres (q, 3) f8, centre_ids (q,) u8, radius, key, patches (q, N, 3) f4 out, "
     "frames (q, 3, 3) f8 out, counts (q,) i8 out)"},
    {"mean_vectors", mean_vectors, METH_VARARGS,
     "mean_vectors(index, vectors (n, 3) f8, first, radius, enough, means (q, 3) f8 out, squares (q,) f8 out, "
     "counts (q,) i8 out)"},
    {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {PyModuleDef_HEAD_INIT, "_native", "Compiled part of pointfilter.patches.", 0, methods,
                      nullptr,               nullptr,   nullptr,                                 nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__native() { return PyModule_Create(&module); }

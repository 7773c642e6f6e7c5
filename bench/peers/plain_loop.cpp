// Eqs 7-9 as they are written: for every candidate and every shift, the cosine distance column by column;
// only the norms of the columns, which no shift changes, are taken beforehand (and timed). Our own stand-in for a straightforward C++ program; one thread. Reads raw float32 files.
// The milliseconds are the median of three runs.
//
//   plain_loop CANDIDATES QUERY RINGS SECTORS COUNT -> milliseconds, best candidate, its shift, its distance
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <limits>
#include <vector>

static std::vector<float> read(const char *path, size_t size) {
    std::vector<float> values(size);
    std::ifstream in(path, std::ios::binary);
    if (!in.read(reinterpret_cast<char *>(values.data()), size * sizeof(float))) {
        std::cerr << "cannot read " << path << "\n";
        std::exit(2);
    }
    return values;
}

// Norms of the columns of one descriptor, (rings, sectors).
static void column_norms(const float *values, int rings, int sectors, double *norms) {
    for (int j = 0; j < sectors; ++j) {
        double sum = 0.0;
        for (int r = 0; r < rings; ++r) sum += double(values[r * sectors + j]) * values[r * sectors + j];
        norms[j] = std::sqrt(sum);
    }
}

// Distance for the query turned by `shift` sectors.
static double distance(const float *query, const double *query_norms, const float *candidate,
                       const double *candidate_norms, int rings, int sectors, int shift) {
    double sum = 0.0;
    for (int j = 0; j < sectors; ++j) {
        const int turned = (j + shift) % sectors;
        double dot = 0.0;
        for (int r = 0; r < rings; ++r) dot += double(query[r * sectors + turned]) * candidate[r * sectors + j];
        const double norms = query_norms[turned] * candidate_norms[j];
        sum += norms > 0.0 ? 1.0 - dot / norms : 1.0;
    }
    return sum / sectors;
}

int main(int argc, char **argv) {
    if (argc != 6) return 2;
    const int rings = std::atoi(argv[3]), sectors = std::atoi(argv[4]), count = std::atoi(argv[5]);
    const size_t size = size_t(rings) * sectors;
    const std::vector<float> candidates = read(argv[1], size * count), query = read(argv[2], size);
    std::vector<double> query_norms(sectors), candidate_norms(sectors);
    double best = 0.0, taken[3];
    int station = -1, shift = -1;
    for (double &milliseconds : taken) {
        const auto start = std::chrono::steady_clock::now();
        best = std::numeric_limits<double>::max();
        column_norms(query.data(), rings, sectors, query_norms.data());
        for (int m = 0; m < count; ++m) {
            const float *candidate = &candidates[m * size];
            column_norms(candidate, rings, sectors, candidate_norms.data());
            for (int n = 0; n < sectors; ++n) {
                const double d = distance(query.data(), query_norms.data(), candidate, candidate_norms.data(),
                                          rings, sectors, n);
                if (d < best) best = d, station = m, shift = n;
            }
        }
        milliseconds = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
    }
    std::sort(taken, taken + 3);
    std::printf("%.3f %d %d %.7f\n", taken[1], station, shift, best);
}

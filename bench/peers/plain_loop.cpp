// Eqs 7-9 as they are written: for every candidate and every shift, the cosine distance column by column.
// Our own stand-in for a straightforward C++ program; one thread. Reads raw float32 files.
//
//   plain_loop CANDIDATES QUERY RINGS SECTORS COUNT -> milliseconds, best candidate, its shift, its distance
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

// One descriptor, (rings, sectors); distance for the query turned by `shift` sectors.
static double distance(const float *query, const float *candidate, int rings, int sectors, int shift) {
    double sum = 0.0;
    for (int j = 0; j < sectors; ++j) {
        const int turned = (j + shift) % sectors;
        double dot = 0.0, qq = 0.0, cc = 0.0;
        for (int r = 0; r < rings; ++r) {
            const double q = query[r * sectors + turned], c = candidate[r * sectors + j];
            dot += q * c;
            qq += q * q;
            cc += c * c;
        }
        sum += qq > 0.0 && cc > 0.0 ? 1.0 - dot / (std::sqrt(qq) * std::sqrt(cc)) : 1.0;
    }
    return sum / sectors;
}

int main(int argc, char **argv) {
    if (argc != 6) return 2;
    const int rings = std::atoi(argv[3]), sectors = std::atoi(argv[4]), count = std::atoi(argv[5]);
    const size_t size = size_t(rings) * sectors;
    const std::vector<float> candidates = read(argv[1], size * count), query = read(argv[2], size);
    const auto start = std::chrono::steady_clock::now();
    double best = std::numeric_limits<double>::max();
    int station = -1, shift = -1;
    for (int m = 0; m < count; ++m)
        for (int n = 0; n < sectors; ++n) {
            const double d = distance(query.data(), &candidates[m * size], rings, sectors, n);
            if (d < best) best = d, station = m, shift = n;
        }
    const std::chrono::duration<double, std::milli> taken = std::chrono::steady_clock::now() - start;
    std::printf("%.3f %d %d %.7f\n", taken.count(), station, shift, best);
}

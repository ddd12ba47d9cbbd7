// hdf5_files.hpp: the files that h5py and others wrote for the tests of the reader (tests/hdf5/make.py).
#pragma once

#include "../data/hdf5.hpp"

// The bytes of tests/hdf5/NAME.z, which holds their number in 8 bytes and then a zlib stream.
inline std::string hdf5_bytes(const std::string& name) {
    const std::string packed = read_file("tests/hdf5/" + name + ".z");
    const auto bytes = inflate_zlib(as_bytes(packed).subspan(8), little_endian(as_bytes(packed).first(8)));
    return {bytes.begin(), bytes.end()};
}

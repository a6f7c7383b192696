// Declares protobuf's maps with the layout that they have in Debian's library.
//
// Under the thread sanitizer the header adds two members to every map field. The library is built
// without them, so that it would look for the other members at the wrong place.
//
// Included before every source of the `tsan` preset that uses protobuf, by the compiler.
#pragma once

#pragma push_macro("__SANITIZE_THREAD__")
#undef __SANITIZE_THREAD__
#include <google/protobuf/map_field.h>
#pragma pop_macro("__SANITIZE_THREAD__")

# Finds an existing source and build folder of Tungsten. Downloads and builds nothing.
#
# Input, as CMake or environment variables:
#   Tungsten_ROOT    the source folder
#   Tungsten_BUILD   the folder it was built in (default: build or builds/release in the source folder, or beside
#                    it with -build added to its name)
# Output:
#   Tungsten::Tungsten              headers, definitions, flags and libraries, as the build itself used them
#   Tungsten_ARCHIVES               the names of its static libraries, separated by colons
#   Tungsten_POSITION_INDEPENDENT   whether they can be linked into a Python module

foreach(name ROOT BUILD)
  if(NOT Tungsten_${name} AND DEFINED ENV{Tungsten_${name}})
    set(Tungsten_${name} "$ENV{Tungsten_${name}}")
  endif()
endforeach()

if(NOT EXISTS "${Tungsten_ROOT}/src/core/cameras/OutputBuffer.hpp")
  message(FATAL_ERROR "Tungsten_ROOT: expected Tungsten's source folder, got '${Tungsten_ROOT}', "
                      "which has no src/core/cameras/OutputBuffer.hpp; name the checkout")
endif()
get_filename_component(Tungsten_ROOT "${Tungsten_ROOT}" REALPATH)
if(NOT Tungsten_BUILD)
  foreach(folder "${Tungsten_ROOT}/build" "${Tungsten_ROOT}/builds/release" "${Tungsten_ROOT}-build")
    if(EXISTS "${folder}/CMakeCache.txt")
      set(Tungsten_BUILD "${folder}")
      break()
    endif()
  endforeach()
endif()
if(NOT EXISTS "${Tungsten_BUILD}/CMakeCache.txt")
  message(FATAL_ERROR "Tungsten_BUILD: expected the folder that Tungsten was built in, got '${Tungsten_BUILD}', "
                      "which has no CMakeCache.txt; build Tungsten and name that folder")
endif()
get_filename_component(Tungsten_BUILD "${Tungsten_BUILD}" REALPATH)

# --- What the build says of itself -------------------------------------------------------------------------------

load_cache("${Tungsten_BUILD}" READ_WITH_PREFIX tungsten_cache_
           CMAKE_HOME_DIRECTORY CMAKE_GENERATOR CMAKE_CXX_COMPILER CMAKE_NM)
get_filename_component(tungsten_home "${tungsten_cache_CMAKE_HOME_DIRECTORY}" REALPATH)
if(NOT tungsten_home STREQUAL Tungsten_ROOT)
  message(FATAL_ERROR "Tungsten_BUILD was configured from ${tungsten_home}, but Tungsten_ROOT is ${Tungsten_ROOT}; "
                      "name the two that belong together")
endif()

# Sets <out> to the value of `NAME = value` in the lines that describe a target.
function(tungsten_read_assignment out text name)
  string(REGEX MATCH "(^|\n) *${name} = ([^\n]*)" ignored "${text}")
  set(${out} "${CMAKE_MATCH_2}" PARENT_SCOPE)
endfunction()

if(tungsten_cache_CMAKE_GENERATOR STREQUAL "Ninja")
  file(READ "${Tungsten_BUILD}/build.ninja" tungsten_rules)
  set(tungsten_lines "[^\n]*\n(  [^\n]*\n)*")
  foreach(target core tungsten)
    set(source "src/core/Debug")
    if(target STREQUAL "tungsten")
      set(source "src/tungsten/tungsten")
    endif()
    string(REGEX MATCH "\nbuild CMakeFiles/${target}.dir/${source}.cpp.o:${tungsten_lines}" rule "${tungsten_rules}")
    tungsten_read_assignment(tungsten_${target}_defines "${rule}" "DEFINES")
    tungsten_read_assignment(tungsten_${target}_flags "${rule}" "FLAGS")
    tungsten_read_assignment(tungsten_${target}_includes "${rule}" "INCLUDES")
  endforeach()
  string(REGEX MATCH "\nbuild tungsten: CXX_EXECUTABLE_LINKER${tungsten_lines}" rule "${tungsten_rules}")
  tungsten_read_assignment(tungsten_link "${rule}" "LINK_LIBRARIES")
elseif(tungsten_cache_CMAKE_GENERATOR STREQUAL "Unix Makefiles")
  foreach(target core tungsten)
    file(READ "${Tungsten_BUILD}/CMakeFiles/${target}.dir/flags.make" rule)
    tungsten_read_assignment(tungsten_${target}_defines "${rule}" "CXX_DEFINES")
    tungsten_read_assignment(tungsten_${target}_flags "${rule}" "CXX_FLAGS")
    tungsten_read_assignment(tungsten_${target}_includes "${rule}" "CXX_INCLUDES")
  endforeach()
  file(READ "${Tungsten_BUILD}/CMakeFiles/tungsten.dir/link.txt" rule)
  string(REGEX REPLACE ".* -o tungsten +([^\n]*).*" "\\1" tungsten_link "${rule}")
else()
  message(FATAL_ERROR "Tungsten_BUILD: expected a build by the generator Ninja or Unix Makefiles, "
                      "got ${tungsten_cache_CMAKE_GENERATOR}; configure Tungsten with one of these")
endif()
if(NOT tungsten_core_defines OR NOT tungsten_link)
  message(FATAL_ERROR "Tungsten_BUILD: found no rules for the targets core and tungsten in ${Tungsten_BUILD}; "
                      "configure Tungsten there again")
endif()

# --- Libraries ---------------------------------------------------------------------------------------------------

set(tungsten_libraries "")
set(tungsten_archive_names "")
separate_arguments(tungsten_link UNIX_COMMAND "${tungsten_link}")
foreach(library IN LISTS tungsten_link)
  if(library MATCHES "\\.a$" AND NOT IS_ABSOLUTE "${library}")
    set(library "${Tungsten_BUILD}/${library}")
    if(NOT EXISTS "${library}")
      message(FATAL_ERROR "Tungsten_BUILD: ${library} is missing; build Tungsten's targets core, thirdparty, embree")
    endif()
    get_filename_component(archive "${library}" NAME)
    list(APPEND tungsten_archive_names "${archive}")
  endif()
  list(APPEND tungsten_libraries "${library}")
endforeach()
list(REMOVE_DUPLICATES tungsten_archive_names)
list(JOIN tungsten_archive_names ":" Tungsten_ARCHIVES)

# --- Definitions, checked against the libraries that are there ----------------------------------------------------

if(NOT tungsten_core_defines STREQUAL tungsten_tungsten_defines)
  message(FATAL_ERROR "Tungsten_BUILD: its targets core and tungsten are compiled with different definitions: "
                      "'${tungsten_core_defines}' and '${tungsten_tungsten_defines}'; configure Tungsten again")
endif()
if(NOT tungsten_cache_CMAKE_NM)
  set(tungsten_cache_CMAKE_NM "${CMAKE_NM}")
endif()
execute_process(COMMAND "${tungsten_cache_CMAKE_NM}" --undefined-only "${Tungsten_BUILD}/libcore.a"
                OUTPUT_VARIABLE tungsten_symbols ERROR_QUIET)
foreach(feature "OPENEXR_AVAILABLE Imf" "JPEG_AVAILABLE jpeg_" "OPENVDB_AVAILABLE openvdb")
  string(REPLACE " " ";" feature "${feature}")
  list(GET feature 0 definition)
  list(GET feature 1 symbol)
  string(FIND "${tungsten_symbols}" "${symbol}" used)
  string(FIND " ${tungsten_core_defines} " " -D${definition} " defined)
  if((used EQUAL -1 AND NOT defined EQUAL -1) OR (NOT used EQUAL -1 AND defined EQUAL -1))
    message(FATAL_ERROR "Tungsten_BUILD: ${definition} differs between the configuration and libcore.a, which was "
                        "compiled before it changed; build Tungsten again")
  endif()
endforeach()
unset(tungsten_symbols)

# Whatever may change a class's layout comes along as it stands. Not along: warnings, the language standard and
# position independence, which are ours to choose.
separate_arguments(tungsten_flags UNIX_COMMAND "${tungsten_core_flags}")
list(FILTER tungsten_flags EXCLUDE REGEX "^(-W.*|-w|-std=.*|-fPIE|-fPIC)$")
list(JOIN tungsten_flags " " tungsten_flags)

separate_arguments(tungsten_core_defines UNIX_COMMAND "${tungsten_core_defines}")
list(TRANSFORM tungsten_core_defines REPLACE "^-D" "")
separate_arguments(tungsten_core_includes UNIX_COMMAND "${tungsten_core_includes}")
list(TRANSFORM tungsten_core_includes REPLACE "^-(I|isystem)" "")
list(REMOVE_ITEM tungsten_core_includes "")

if(" ${tungsten_core_flags} " MATCHES " -fPIC ")
  set(Tungsten_POSITION_INDEPENDENT TRUE)
else()
  set(Tungsten_POSITION_INDEPENDENT FALSE)
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(Tungsten REQUIRED_VARS Tungsten_ROOT Tungsten_BUILD tungsten_libraries)
if(NOT TARGET Tungsten::Tungsten)
  add_library(Tungsten::Tungsten INTERFACE IMPORTED)
  set_target_properties(Tungsten::Tungsten PROPERTIES
    INTERFACE_INCLUDE_DIRECTORIES "${tungsten_core_includes}"
    INTERFACE_COMPILE_DEFINITIONS "${tungsten_core_defines}"
    INTERFACE_COMPILE_OPTIONS "SHELL:${tungsten_flags}"
    INTERFACE_LINK_LIBRARIES "${tungsten_libraries}")
endif()

// The native `tungsten` command: the stock driver, and Tungsten beneath an embedded Python for the --dip
// flags.
//
// Without a --dip or --host flag no Python starts. With one, the interpreter that the package was installed
// for (or TUNGSTEN_DIP_PYTHON) runs tungsten_dip's own command in this process, with Tungsten linked in.
#include <pybind11/embed.h>

#include <cstdlib>
#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

#include "bindings.hpp"
#include "render.hpp"

namespace {

// The package need not be on the interpreter's path: this command lies in its folder bin/.
constexpr const char* run_command = R"(
import sys
from pathlib import Path
package = Path(sys.argv.pop(1))
if (package / "errors.py").exists():
    sys.path.insert(0, str(package.parent))
import _tungsten
sys.modules["tungsten_dip._tungsten"] = _tungsten
try:
    if sys.argv[1:2] == ["--dip-render-buffers"]:
        from tungsten_dip.hosts.native import render_to_folder as main
    else:
        from tungsten_dip.cli.tungsten import main
except ImportError as error:
    print(f"tungsten: {sys.executable}: expected the Python that tungsten_dip was installed for ({error}); "
          "name it in the environment variable TUNGSTEN_DIP_PYTHON", file=sys.stderr)
    sys.exit(2)
sys.argv[0] = "tungsten"
sys.exit(main(sys.argv[1:]))
)";

bool needs_python(int argc, const char* const* argv) {
    for (int i = 1; i < argc && std::string_view(argv[i]) != "--"; ++i) {
        const std::string_view argument = argv[i];
        if (argument.starts_with("--dip-") || argument == "--host" || argument.starts_with("--host="))
            return true;
    }
    return false;
}

int run_python(int argc, char** argv) {
    namespace fs = std::filesystem;
    // NOLINTNEXTLINE(concurrency-mt-unsafe): no other thread runs yet
    const char* asked_python = std::getenv("TUNGSTEN_DIP_PYTHON");
    const std::string python = asked_python != nullptr ? asked_python : TUNGSTEN_DIP_PYTHON;
    const std::string package = fs::read_symlink("/proc/self/exe").parent_path().parent_path().string();

    std::vector<const char*> arguments{argv[0], "-c", run_command, package.c_str()};
    arguments.insert(arguments.end(), argv + 1, argv + argc);

    PyConfig config;
    PyConfig_InitPythonConfig(&config);
    // The current folder, which may hold a scene from anywhere, is no place to import from.
    config.safe_path = 1;
    // A virtual environment is found from the name of its interpreter.
    PyStatus status = PyConfig_SetBytesString(&config, &config.program_name, python.c_str());
    if (PyStatus_Exception(status) == 0)
        status = PyConfig_SetBytesArgv(&config, static_cast<Py_ssize_t>(arguments.size()),
                                       const_cast<char* const*>(arguments.data()));
    if (PyStatus_Exception(status) == 0) status = Py_InitializeFromConfig(&config);
    PyConfig_Clear(&config);
    if (PyStatus_Exception(status) != 0) Py_ExitStatusException(status);
    return Py_RunMain();
}

}  // namespace

PYBIND11_EMBEDDED_MODULE(_tungsten, module) { tungsten_dip::bind(module); }

int main(int argc, char** argv) {
    if (needs_python(argc, argv)) return run_python(argc, argv);
    return tungsten_dip::run_stock(argc, const_cast<const char**>(argv));
}

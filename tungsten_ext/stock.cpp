// The stock driver of the found Tungsten, unchanged, but a scene that failed shows in the exit status.
#include "render.hpp"

// Tungsten's driver relies on being included after these.
#include <iostream>
#include <memory>

#include "Version.hpp"
#include "tungsten/Shared.hpp"

namespace tungsten_dip {

int run_stock(int argc, const char** argv) {
    Tungsten::CliParser parser("tungsten", "[options] scene1 [scene2 [scene3...]]");
    Tungsten::StandaloneRenderer renderer(parser, std::cout);
    parser.parse(argc, argv);
    if (parser.isPresent(Tungsten::OPT_VERSION)) {
        std::cout << "tungsten, version " << VERSION_STRING << "\n";
        return 0;
    }
    renderer.setup();
    while (renderer.renderScene()) {
    }
    return renderer.status().completedScenes.size() == parser.operands().size() ? 0 : 1;
}

}  // namespace tungsten_dip

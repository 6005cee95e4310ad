// tungsten_mixed: two BSDFs by weight. A direction that one of them sampled is weighed against the density of
// the other even where it is a single direction, which has none: Tungsten does so too.
//
//   bsdf_0, bsdf_1   the BSDFs
//   ratio            texture: the weight of bsdf_0
//   albedo           texture: colours both
#include <array>
#include <string>

#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Mixed final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture, BSDF)

    explicit Mixed(const Properties& props) : Base(props) {
        ratio_ = props.get_texture<Texture>("ratio", 0.5f);
        albedo_ = props.get_texture<Texture>("albedo", 1.f);
        for (size_t part = 0; part < 2; ++part) {
            auto nested = props.get<ref<Object>>("bsdf_" + std::to_string(part));
            parts_[part] = dynamic_cast<BSDF*>(nested.get());
            if (!parts_[part]) Throw("Expected a nested BSDF bsdf_%u", part);
            for (size_t i = 0; i < parts_[part]->component_count(); ++i)
                Base::add_component(parts_[part]->flags(i));
        }
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& context, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        const Float ratio = ratio_->eval_1(si);
        const size_t chosen = sample1 < ratio ? 0 : 1;
        const Float share = chosen == 0 ? ratio : 1.f - ratio;
        const Float reused = chosen == 0 ? sample1 / ratio : (sample1 - ratio) / (1.f - ratio);
        auto [bs, weight] = parts_[chosen]->sample(context, si, reused, sample2, active);
        const bool failed = dr::all(weight == 0.f) && bs.wo.z() * si.wi.z() <= 0.f;
        if (failed || !(bs.pdf > 0.f)) return {bs, Spectrum(0.f)};
        const auto [value, density] = parts_[1 - chosen]->eval_pdf(context, si, bs.wo, active);
        const Spectrum total = weight * bs.pdf * share + value * (1.f - share);
        bs.pdf = bs.pdf * share + density * (1.f - share);
        if (chosen == 1) bs.sampled_component += static_cast<uint32_t>(parts_[0]->component_count());
        return {bs, albedo_->eval(si) * total / bs.pdf};
    }

    MI_DECLARE_CLASS(Mixed)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        const Float ratio = ratio_->eval_1(si);
        const auto [value_0, density_0] = parts_[0]->eval_pdf(BSDFContext(), si, wo, true);
        const auto [value_1, density_1] = parts_[1]->eval_pdf(BSDFContext(), si, wo, true);
        return {albedo_->eval(si) * (value_0 * ratio + value_1 * (1.f - ratio)),
                density_0 * ratio + density_1 * (1.f - ratio)};
    }

  private:
    std::array<ref<BSDF>, 2> parts_;
    ref<Texture> ratio_;
    ref<Texture> albedo_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Mixed<float, Rgb>)
